# SPDX-License-Identifier: Apache-2.0
"""The memory of drivers, in the user's cache: by driver and kernel shape what has passed, and what has failed.

An entry counts for one device, driver and set of kernels, so that a new version of any of them is tried anew.
"""

from __future__ import annotations

import json
import os
import threading
import warnings
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import pyopencl as cl

import clsplat
from clsplat.device.source import kernel_root, kernel_source
from clsplat.device.traits import pretended
from clsplat.errors import reason_of
from clsplat.files import atomic_write, locked, parse_json

BREAK = "CLSPLAT_BREAK_KERNEL"
"""Variable for the tests of `clsplat selftest` alone: STEM: WORDS => WORDS replaces words of one kernel's text, as a
driver that miscompiles an operation would."""
MOST = 16
"""Drivers and versions that are remembered, the latest: each takes a few KiB."""


@dataclass(frozen=True)
class Entry:
    """One driver in one shape. stages: those of the self-test that passed; kernels: what has been built and launched,
    as `rehearsal` names it, with the salt that its text needs; failed: how the driver failed, or empty, or in an
    addition None to leave it as it is; trial: what it failed in, if that was a single kernel: its name, and what
    `rehearsal.again` needs to try it."""

    stages: frozenset[str] = frozenset()
    kernels: Mapping[str, str] = field(default_factory=dict)
    failed: str | None = ""
    trial: Mapping[str, Any] = field(default_factory=dict)


def cache_folder() -> Path:
    """Our part of the user's cache; a place that takes nothing for a user without a home, such as a container's."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "clsplat"
    except RuntimeError:
        return Path(os.devnull) / "clsplat"


def memory_path() -> Path:
    """The file."""
    return cache_folder() / "drivers.json"


@lru_cache(maxsize=4)
def _kernels_digest(broken: str) -> str:
    texts = "".join(kernel_source(path.stem) for path in sorted(kernel_root().glob("*.cl")))
    return f"{zlib.crc32((texts + broken).encode()):08x}"


def device_key(device: cl.Device) -> str:
    """A device and its driver, and what is pretended of it."""
    words = [device.name.strip(), device.platform.version.strip(), device.driver_version.strip()]
    return " | ".join([*words, pretended()] if pretended() else words)


def driver_key(device: cl.Device) -> str:
    """Everything beside the shape that an entry counts for."""
    return f"{device_key(device)} | clsplat {clsplat.__version__} {_kernels_digest(os.environ.get(BREAK, ''))}"


def _entry(value: object) -> Entry:
    """An entry of the file. One that clsplat did not write counts as not there."""
    if not isinstance(value, dict):
        return Entry()
    stages, kernels, failed = value.get("stages", []), value.get("kernels", {}), value.get("failed", "")
    trial = value.get("trial", {})
    if not (isinstance(stages, list) and isinstance(kernels, dict) and isinstance(failed, str)):
        return Entry()
    if not all(isinstance(text, str) for text in (*stages, *kernels.values())):
        return Entry()
    return Entry(frozenset(stages), kernels, failed, trial if isinstance(trial, dict) else {})


_LOCK = threading.Lock()
"""Several devices may be at work at once."""
_unwritten: dict[Path, list[tuple[str, str, Entry]]] = {}
"""Additions that could not be written yet, by file: driver, shape and what is added to the entry."""


def _read() -> dict[str, Any]:
    """The file, with the additions that are not in it yet."""
    try:
        saved = parse_json(memory_path().read_bytes())
    except (OSError, ValueError):
        saved = {}
    if not isinstance(saved, dict):
        saved = {}
    for addition in _unwritten.get(memory_path(), []):
        _add(saved, *addition)
    return saved


def _add(saved: dict[str, Any], driver: str, shape: str, addition: Entry) -> None:
    shapes = saved.pop(driver, None)
    shapes = shapes if isinstance(shapes, dict) else {}
    known = _entry(shapes.get(shape))
    entry: dict[str, object] = {
        "stages": sorted(known.stages | addition.stages),
        "kernels": {**known.kernels, **addition.kernels},
    }
    last = known if addition.failed is None else addition
    if last.failed:
        entry |= {"failed": last.failed, **({"trial": last.trial} if last.trial else {})}
    saved[driver] = {**shapes, shape: entry}


def entries(device: cl.Device) -> dict[str, Entry]:
    """All entries of the driver, by LANESxITEMS."""
    shapes = _read().get(driver_key(device))
    return {name: _entry(value) for name, value in shapes.items()} if isinstance(shapes, dict) else {}


def remember(
    device: cl.Device,
    shape: str,
    *,
    stages: Iterable[str] = (),
    kernels: Mapping[str, str] | None = None,
    failed: str | None = None,
    trial: Mapping[str, Any] | None = None,
) -> None:
    """Add to the entry of the driver in a shape, LANESxITEMS. failed: None keeps the recorded failure; trial: see
    `Entry`.

    A folder that cannot be written is a warning; while it cannot, everything is tried anew by the next process.
    """
    path = memory_path()
    addition = Entry(frozenset(stages), kernels or {}, failed, trial or {})
    with _LOCK:
        _unwritten.setdefault(path, []).append((driver_key(device), shape, addition))
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with locked(path):
                saved = _read()
                for oldest in list(saved)[:-MOST]:
                    del saved[oldest]
                atomic_write(path, (json.dumps(saved, indent=1) + "\n").encode())
            del _unwritten[path]
        except OSError as error:
            tell_once(f"{path}: cannot be written ({reason_of(error)}), so that drivers are tested anew each time")


@lru_cache(maxsize=8)
def tell_once(text: str) -> None:
    """A warning, once in a process."""
    warnings.warn(text, stacklevel=2)
