# SPDX-License-Identifier: Apache-2.0
"""Claims of files that this process holds, with the updates by which other processes see that it is alive.

`clsplat.files.locks` decides when another process takes over the claim of a killed one: at once on the same machine,
and after ABANDONED_FILE_SECONDS without an update on another machine.
"""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from pathlib import Path

from clsplat.files.locks import claim, give_back, is_own_marker

CLAIM_HEARTBEAT_SECONDS = 60.0
"""Seconds between updates of a claim file's modification time, so that it stays younger than ABANDONED_FILE_SECONDS."""


class HeldClaims:
    """The claims that this process holds. All methods are thread-safe."""

    def __init__(self) -> None:
        self._markers: dict[Path, Path] = {}
        self._changing, self._closed = threading.Lock(), threading.Event()
        threading.Thread(target=self._update, name="clsplat-claims", daemon=True).start()

    def take(self, target: Path) -> bool:
        """Claim the file or task `target`. Returns False if another process has the claim. Raises OSError."""
        if (marker := claim(target)) is None:
            return False
        with self._changing:
            self._markers[target] = marker
        return True

    def release(self, target: Path) -> None:
        """Give up the claim of `target`, if this process has it. Raises OSError."""
        with self._changing:
            marker = self._markers.pop(target, None)
        if marker is not None:
            give_back(marker)

    def close(self) -> None:
        """Give up all claims."""
        self._closed.set()
        with self._changing:
            markers, self._markers = list(self._markers.values()), {}
        for marker in markers:
            with suppress(OSError):
                give_back(marker)

    def _update(self) -> None:
        """Update the claim files' modification times until `close`, because a frame or a task may take hours."""
        while not self._closed.wait(CLAIM_HEARTBEAT_SECONDS):
            with self._changing:
                for marker in self._markers.values():
                    with suppress(OSError):
                        if is_own_marker(marker):
                            os.utime(marker)  # unlike Path.touch, does not create a missing file
