# SPDX-License-Identifier: Apache-2.0
"""The weights of LPIPS' network: their place for torch, and their download."""

from __future__ import annotations

import hashlib
import math
import os
import threading
import time
import urllib.request
from pathlib import Path

from clsplat.errors import ClsplatError, InputError
from clsplat.files import atomic_writer, is_file
from clsplat.progress import StageProgress

URL = "https://download.pytorch.org/models/vgg16-397923af.pth"
"""Address of VGG-16's weights, about 530 MB. The name has the first digits of the file's SHA-256."""
VARIABLE = "CLSPLAT_LPIPS_TIMEOUT"
LONGEST = 300.0
"""Seconds that the weights may take to come, unless VARIABLE says otherwise."""
SILENCE = 20.0
"""Seconds without a byte after which a server, or a proxy, counts as silent."""


def place() -> Path:
    """The path at which torch looks for the file."""
    home = os.environ.get("TORCH_HOME") or Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "torch"
    return Path(home).expanduser() / "hub" / "checkpoints" / URL.rpartition("/")[2]


def limit() -> float:
    """Seconds that the download may take. Raises InputError for a VARIABLE that is no number from 0 up."""
    text = os.environ.get(VARIABLE) or str(LONGEST)
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0 <= seconds < threading.TIMEOUT_MAX:
        raise InputError(f"{VARIABLE} is {text!r}, expected seconds, or 0 to fetch nothing")
    return seconds


def fetch() -> None:
    """Get the file, if it is not there, with progress on standard error. Raises ClsplatError, which says what to do."""
    path, seconds = place(), limit()
    if is_file(path):
        return
    advice = f"curl --create-dirs -o {path} {URL}"
    if seconds == 0:
        raise ClsplatError(f"VGG-16's weights are not there: {advice}")
    transfer = _Transfer(daemon=True)  # a name that is looked up knows no limit
    progress = StageProgress()
    transfer.start()
    until = time.monotonic() + seconds
    while transfer.is_alive() and time.monotonic() < until:
        transfer.join(min(0.5, max(until - time.monotonic(), 0.0)))
        progress(f"fetching VGG-16's weights for LPIPS, for {seconds:g} s at most ({VARIABLE})", transfer.fraction)
    transfer.cancelled = True
    if transfer.is_alive():
        raise ClsplatError(f"VGG-16's weights did not come within {seconds:g} s ({VARIABLE}): {advice}")
    if transfer.trouble is not None:
        raise ClsplatError(f"VGG-16's weights could not be fetched ({transfer.trouble}): {advice}")


class _Transfer(threading.Thread):
    """The download, and its progress."""

    cancelled = False
    fraction: float | None = None
    trouble: str | None = None

    def run(self) -> None:
        try:
            self._fetch(place())
        except Exception as error:  # noqa: BLE001  # of any kind: it is reported, and evaluation goes on
            self.trouble = " ".join(str(error).split())[:100] or type(error).__name__

    def _fetch(self, path: Path) -> None:
        digest = hashlib.sha256()
        with urllib.request.urlopen(URL, timeout=SILENCE) as answer:
            total, done = int(answer.headers.get("Content-Length") or 0), 0
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_writer(path) as file:
                while block := answer.read(1 << 16):
                    if self.cancelled:
                        raise ClsplatError("it took too long")
                    digest.update(block)
                    file.write(block)
                    done += len(block)
                    self.fraction = min(done / total, 0.99) if total else None
                wanted = URL.rpartition("-")[2].partition(".")[0]
                if not digest.hexdigest().startswith(wanted):
                    raise ClsplatError(f"what came has another digest than {wanted}")
