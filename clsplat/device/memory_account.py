# SPDX-License-Identifier: Apache-2.0
"""Memory account of a device: the bytes of its buffers, their peak, and the limit of --max-device-mem."""

from __future__ import annotations

import gc
import weakref
from typing import Any

from clsplat.errors import CapacityError, amount


class Memory:
    """The account of one device's buffers in bytes: `used` now, `peak` (the maximum of `used`), and `limit` or None."""

    def __init__(self, limit: int | None = None) -> None:
        self.limit = limit
        self.used = 0
        self.peak = 0

    def check(self, nbytes: int) -> None:
        """Raise CapacityError if `nbytes` more bytes would exceed the limit."""
        if self.limit is None or self.used + nbytes <= self.limit:
            return
        gc.collect()  # frees buffers that only a reference cycle or a traceback refers to
        if self.used + nbytes > self.limit:
            raise CapacityError(
                f"--max-device-mem {amount(self.limit)} is too little: {amount(self.used)} of the device's memory are "
                f"in use, and {amount(nbytes)} more are needed; allow more, or use a smaller resolution or fewer "
                "Gaussians (--density.max-gaussians)"
            )

    def add(self, buffer: Any, nbytes: int) -> None:
        """Count a buffer's bytes for as long as the buffer exists."""
        self.used += nbytes
        self.peak = max(self.peak, self.used)
        weakref.finalize(buffer, self._remove, nbytes).atexit = False

    def _remove(self, nbytes: int) -> None:
        self.used -= nbytes
