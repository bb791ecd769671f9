# SPDX-License-Identifier: Apache-2.0
"""What is alive in a device's memory, and what may be."""

from __future__ import annotations

import gc
import weakref
from typing import Any

from clsplat.errors import CapacityError


class Memory:
    """The account of one device's buffers: `used` and `peak` bytes, and the `limit` that they stay within, or None."""

    def __init__(self, limit: int | None = None) -> None:
        self.limit = limit
        self.used = 0
        self.peak = 0

    def check(self, nbytes: int) -> None:
        """Raise CapacityError where so many more would be too many."""
        if self.limit is None or self.used + nbytes <= self.limit:
            return
        gc.collect()  # what an exception's traceback or a cycle still holds is not in use
        if self.used + nbytes > self.limit:
            raise CapacityError(
                f"{mebibytes(nbytes)} more are needed on the device where {mebibytes(self.used)} are in use and "
                f"--max-device-mem allows {mebibytes(self.limit)}: allow more, or use a smaller resolution or fewer "
                "Gaussians (--density.max-gaussians)"
            )

    def add(self, buffer: Any, nbytes: int) -> None:
        """Count a buffer for as long as the object lives."""
        self.used += nbytes
        self.peak = max(self.peak, self.used)
        weakref.finalize(buffer, self._remove, nbytes).atexit = False

    def _remove(self, nbytes: int) -> None:
        self.used -= nbytes


def mebibytes(nbytes: int) -> str:
    """For messages: whole MiB, or KiB where those would say little."""
    return f"{nbytes / 2**20:,.0f} MiB" if nbytes >= 10 * 2**20 else f"{nbytes / 2**10:,.0f} KiB"
