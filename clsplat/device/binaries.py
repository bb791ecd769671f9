# SPDX-License-Identifier: Apache-2.0
"""A cache of built programs, for a driver that has none of its own and builds everything anew in each process.

A file has a digest of its contents first: a driver may crash on half a binary. Its name stands for all that the
binary depends on: the text, the options, the driver, and the processor with what the driver is told of it.
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

from clsplat.device.known import cache_folder
from clsplat.device.processor import features
from clsplat.device.quirks import TARGET, wants_cache
from clsplat.files import atomic_write

MOST_BYTES = 256 << 20
"""Limit of all files together; the oldest go. A binary takes 30 to 500 KB, all tests together 90 MB."""

FOLDER = "CLSPLAT_BINARIES"
"""The variable that names another place."""


def folder() -> Path:
    """The place of the files."""
    return Path(os.environ.get(FOLDER, "").strip() or cache_folder() / "binaries")


def _path(device: cl.Device, digest: str) -> Path:
    settings = sorted(f"{name}={value}" for name, value in os.environ.items() if name.startswith(TARGET))
    driver = (device.name, device.platform.version, device.driver_version)
    # a processor's name is not enough: a home may serve many machines
    processor = " ".join((platform.machine(), platform.processor(), *sorted(features())))
    key = "\0".join((digest, *driver, processor, *settings))
    return folder() / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.bin"


def load(context: cl.Context, device: cl.Device, digest: str, options: Sequence[str]) -> cl.Program | None:
    """The program of a variant's digest as it was saved; None where it was not, or cannot be used any more."""
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
        os.utime(path)  # the oldest is the one that was not used for longest
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", cl.CompilerWarning)
            program = cl.Program(context, [device], [binary]).build(options=list(options))
            return program if program.num_kernels else None
    except cl.Error:
        return None


def save(device: cl.Device, digest: str, program: cl.Program) -> None:
    """Keep a program that has kernels. A folder that takes nothing is no error: the next process builds anew."""
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
    """Remove the oldest files beyond MOST_BYTES."""
    files = []
    for entry in os.scandir(place):
        if not re.fullmatch(r"[0-9a-f]{32}\.bin", entry.name):  # CLSPLAT_BINARIES may name a folder of other files too
            continue
        with contextlib.suppress(OSError):  # another process removes them too
            status = entry.stat()
            files.append((status.st_mtime, status.st_size, entry.path))
    total = sum(size for _, size, _ in files)
    for _, size, path in sorted(files):
        if total <= MOST_BYTES:
            return
        with contextlib.suppress(OSError):
            Path(path).unlink()
        total -= size
