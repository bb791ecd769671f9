# SPDX-License-Identifier: Apache-2.0
"""Download of the VGG-16 weights that LPIPS needs, to the path where torch expects them."""

from __future__ import annotations

import hashlib
import math
import os
import threading
import time
import urllib.request
from pathlib import Path

from clsplat.errors import ClsplatError, InputError
from clsplat.files.atomic import atomic_writer
from clsplat.files.documents import is_file
from clsplat.progress import StageProgress

VGG16_WEIGHTS_URL = "https://download.pytorch.org/models/vgg16-397923af.pth"
"""Address of VGG-16's weights, about 530 MB. The file's name ends with the first digits of its SHA-256."""
LPIPS_TIMEOUT_VARIABLE = "CLSPLAT_LPIPS_TIMEOUT"
"""Environment variable with the time limit of the download in seconds. 0: no download."""
LPIPS_DOWNLOAD_SECONDS = 300.0
"""Default time limit of the download in seconds, which LPIPS_TIMEOUT_VARIABLE overrides."""
LPIPS_SERVER_SILENCE_SECONDS = 20.0
"""Seconds without a byte from the server or a proxy after which the download fails."""


def place() -> Path:
    """Path where torch expects the weights file."""
    home = os.environ.get("TORCH_HOME") or Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "torch"
    return Path(home).expanduser() / "hub" / "checkpoints" / VGG16_WEIGHTS_URL.rpartition("/")[2]


def limit() -> float:
    """Return the download's time limit in seconds. Raises InputError if LPIPS_TIMEOUT_VARIABLE has an invalid value."""
    text = os.environ.get(LPIPS_TIMEOUT_VARIABLE) or str(LPIPS_DOWNLOAD_SECONDS)
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0 <= seconds < threading.TIMEOUT_MAX:
        raise InputError(f"{LPIPS_TIMEOUT_VARIABLE} is {text!r}, expected a number of seconds, or 0 for no download")
    return seconds


def fetch() -> None:
    """Download the weights if the file is missing, with progress on standard error.

    Raises ClsplatError if the download fails. The message has a curl command for it.
    """
    path, seconds = place(), limit()
    if is_file(path):
        return
    advice = f"download them with: curl --create-dirs -o {path} {VGG16_WEIGHTS_URL}"
    if seconds == 0:
        raise ClsplatError(f"VGG-16's weights are missing; {advice}")
    transfer = _Transfer(daemon=True)  # in a thread, so that this call can end even if name resolution hangs
    progress = StageProgress()
    transfer.start()
    until = time.monotonic() + seconds
    while transfer.is_alive() and time.monotonic() < until:
        transfer.join(min(0.5, max(until - time.monotonic(), 0.0)))
        progress(
            f"downloading VGG-16's weights for LPIPS, for {seconds:g} s at most ({LPIPS_TIMEOUT_VARIABLE})",
            transfer.fraction,
        )
    transfer.cancelled = True
    if transfer.is_alive():
        raise ClsplatError(f"VGG-16's weights did not arrive in {seconds:g} s ({LPIPS_TIMEOUT_VARIABLE}); {advice}")
    if transfer.trouble is not None:
        raise ClsplatError(f"VGG-16's weights could not be downloaded ({transfer.trouble}); {advice}")


class _Transfer(threading.Thread):
    """Thread that downloads the weights. `fraction` is its progress, `trouble` the reason of a failure."""

    cancelled = False
    fraction: float | None = None
    trouble: str | None = None

    def run(self) -> None:
        try:
            self._fetch(place())
        except Exception as error:  # noqa: BLE001  # an evaluation reports any error and continues
            self.trouble = " ".join(str(error).split())[:100] or type(error).__name__

    def _fetch(self, path: Path) -> None:
        digest = hashlib.sha256()
        with urllib.request.urlopen(VGG16_WEIGHTS_URL, timeout=LPIPS_SERVER_SILENCE_SECONDS) as answer:
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
                wanted = VGG16_WEIGHTS_URL.rpartition("-")[2].partition(".")[0]
                if not digest.hexdigest().startswith(wanted):
                    raise ClsplatError(f"the SHA-256 of the download does not begin with {wanted}")
