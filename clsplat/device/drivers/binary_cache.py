# SPDX-License-Identifier: Apache-2.0
"""Cache of built OpenCL programs (binaries) in files, for a driver that has no cache of its own.

The files are in the folder CLSPLAT_BINARIES, or else in `binaries` of `user_cache.cache_folder`.

A file begins with a digest of its contents, as a driver may crash on a truncated binary. The file's name is a digest of
everything that the binary depends on: the text, the options, the driver and its settings, and the processor.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import re
import warnings
from collections.abc import Sequence
from pathlib import Path

import pyopencl as cl

from clsplat.device.drivers.cpu_name import features
from clsplat.device.drivers.quirks import TARGET_VARIABLE_PREFIX, wants_cache
from clsplat.files.atomic import atomic_write
from clsplat.files.user_cache import cache_folder

MAX_BINARY_CACHE_BYTES = 256 << 20
"""Maximum bytes of all files of the cache. Beyond it, the least recently used files are removed. A binary takes 30 to
500 KB; all binaries of the tests take 90 MB."""

BINARIES_VARIABLE = "CLSPLAT_BINARIES"
"""Environment variable with the folder of the cached binaries, if it is not the default folder."""


def folder() -> Path:
    """Return the folder of the cached binaries: CLSPLAT_BINARIES, or else `binaries` in clsplat's cache folder."""
    return Path(os.environ.get(BINARIES_VARIABLE, "").strip() or cache_folder() / "binaries")


def _path(device: cl.Device, digest: str) -> Path:
    settings = sorted(
        f"{name}={value}" for name, value in os.environ.items() if name.startswith(TARGET_VARIABLE_PREFIX)
    )
    driver = (device.name, device.platform.version, device.driver_version)
    # the processor's features are part of the name, because several machines may share a home folder
    processor = " ".join((platform.machine(), platform.processor(), *sorted(features())))
    key = "\0".join((digest, *driver, processor, *settings))
    return folder() / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.bin"


def load(context: cl.Context, device: cl.Device, digest: str, options: Sequence[str]) -> cl.Program | None:
    """Return the program of a variant from the cache; None if no intact file is found, or the driver refuses the file.

    digest, options: digest and build options of the variant.
    """
    if not wants_cache(device):
        return None
    path = _path(device, digest)
    try:
        content = path.read_bytes()
    except OSError:
        return None
    binary = content[32:]
    if hashlib.sha256(binary).digest() != content[:32]:
        return None
    with contextlib.suppress(OSError):
        os.utime(path)  # marks the file as recently used, as the least recently used files are removed first
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", cl.CompilerWarning)
            program = cl.Program(context, [device], [binary]).build(options=list(options))
            return program if program.num_kernels else None
    except cl.Error:
        return None


def save(device: cl.Device, digest: str, program: cl.Program) -> None:
    """Save the built program of the variant with this digest. Does nothing if the folder is not writable."""
    if not wants_cache(device):
        return
    try:
        binary = program.get_info(cl.program_info.BINARIES)[0]
        path = _path(device, digest)
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(path, hashlib.sha256(binary).digest() + binary)
        _make_room(path.parent)
    except (OSError, cl.Error):
        return


def _make_room(place: Path) -> None:
    """Remove the least recently used binaries in a folder until the rest take at most MAX_BINARY_CACHE_BYTES."""
    files = []
    for entry in os.scandir(place):
        # CLSPLAT_BINARIES may be a folder with other programs' files, which are kept
        if not re.fullmatch(r"[0-9a-f]{32}\.bin", entry.name):
            continue
        with contextlib.suppress(OSError):  # another process may remove files too
            status = entry.stat()
            files.append((status.st_mtime, status.st_size, entry.path))
    total = sum(size for _, size, _ in files)
    for _, size, path in sorted(files):
        if total <= MAX_BINARY_CACHE_BYTES:
            return
        with contextlib.suppress(OSError):
            Path(path).unlink()
        total -= size
