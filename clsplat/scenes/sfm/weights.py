# SPDX-License-Identifier: Apache-2.0
"""Weights of learned features: a file of the user, or a published file, which is fetched with a time limit."""

from __future__ import annotations

import hashlib
import threading
import urllib.error
import urllib.request
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from clsplat.errors import InputError, WriteError, reason_of, warn
from clsplat.files.atomic import atomic_write
from clsplat.files.user_cache import cache_folder

WEIGHTS_FETCH_SECONDS = 30.0
"""Time limit in seconds for fetching weights, from the first connection to the last byte."""
MAX_WEIGHTS_BYTES = 1 << 28
"""Maximum size in bytes of fetched weights."""
DEFAULT_WEIGHTS = "aliked-n16rot"
"""Name of the weights that are fetched if none are given. They tolerate rotated photographs."""


@dataclass(frozen=True)
class PublishedWeights:
    """A published file of weights. sha256: its digest in hexadecimal."""

    url: str
    sha256: str


_RELEASE = "https://github.com/colmap/colmap/releases/download/3.13.0"
WEIGHTS_BY_NAME = {
    "aliked-n16rot": PublishedWeights(
        f"{_RELEASE}/aliked-n16rot.onnx", "39c423d0a6f03d39ec89d3d1d61853765c2fb6a8b8381376c703e5758778a547"
    ),
    "aliked-n32": PublishedWeights(
        f"{_RELEASE}/aliked-n32.onnx", "a077728a02d2de1a775c66df6de8cfeb7c6b51ca57572c64c680131c988c8b3c"
    ),
}
"""Weights of ALIKED (Zhao et al., 2023) as ONNX networks, which the COLMAP project publishes."""


def learned_weights(given: str | None) -> Path | None:
    """Return the file of weights, or None with a warning if published weights cannot be fetched.

    given: path of a file, or a name in WEIGHTS_BY_NAME; None for DEFAULT_WEIGHTS. Published weights are kept in the
        user's cache folder.

    Raises InputError for a file that does not exist, and if onnxruntime is not installed.
    """
    if find_spec("onnxruntime") is None:
        raise InputError("--features aliked: needs onnxruntime, which is not installed: pip install 'clsplat[learned]'")
    name = given or DEFAULT_WEIGHTS
    if name not in WEIGHTS_BY_NAME:
        path = Path(name)
        if not path.is_file():
            names = " or ".join(WEIGHTS_BY_NAME)
            raise InputError(f"--weights {name}: no such file, expected an ONNX file, or the name {names}")
        return path
    try:
        return _fetched(name)
    except _FetchError as error:
        warn(
            f"the weights {name} cannot be fetched from {WEIGHTS_BY_NAME[name].url} ({error}); SIFT features are used "
            "instead. Fetch the file elsewhere and give it with --weights"
        )
        return None


class _FetchError(Exception):
    """Error about weights that cannot be fetched, with the reason."""


def _fetched(name: str) -> Path:
    """Return the file of published weights in the user's cache folder. Fetches it if it is not there."""
    published, kept = WEIGHTS_BY_NAME[name], cache_folder() / "weights" / f"{name}.onnx"
    if kept.is_file() and hashlib.sha256(kept.read_bytes()).hexdigest() == published.sha256:
        return kept
    data = _within(published.url, WEIGHTS_FETCH_SECONDS)
    if hashlib.sha256(data).hexdigest() != published.sha256:
        raise _FetchError(f"the answer of {len(data):,} bytes is not the file: its SHA-256 differs")
    try:
        kept.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(kept, data)
    except (OSError, WriteError) as error:
        raise _FetchError(f"{kept}: {reason_of(error)}") from None
    return kept


def _within(url: str, seconds: float) -> bytes:
    """Return the bytes at a URL. Raises _FetchError if they are not complete within the time limit.

    A thread fetches them, because the time-out of a connection covers neither name servers nor slow answers.
    """
    answer: list[bytes | Exception] = []

    def fetch() -> None:
        try:
            # A new opener, as `urlopen` keeps the proxies of its first call.
            with urllib.request.build_opener().open(url, timeout=seconds) as reply:
                answer.append(reply.read(MAX_WEIGHTS_BYTES))
        except Exception as error:  # noqa: BLE001 - the thread hands every error to the caller
            answer.append(error)

    thread = threading.Thread(target=fetch, daemon=True)
    thread.start()
    thread.join(seconds)
    if not answer or isinstance(answer[0], TimeoutError):
        raise _FetchError(f"no complete answer within {seconds:g} s")
    if isinstance(answer[0], Exception):
        error = answer[0]
        reason = error.reason if isinstance(error, urllib.error.URLError) else error
        if isinstance(reason, TimeoutError):
            raise _FetchError(f"no complete answer within {seconds:g} s")
        raise _FetchError(str(reason) or type(reason).__name__)
    return answer[0]
