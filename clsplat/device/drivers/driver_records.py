# SPDX-License-Identifier: Apache-2.0
"""Driver records in the user's cache: the tests and kernels that passed or failed, per driver and kernel shape.

A record is keyed by device, driver version and kernel sources. So after a change of any of these, a driver is tested
again.
"""

from __future__ import annotations

import json
import os
import threading
import warnings
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import pyopencl as cl

from clsplat.device.drivers.capabilities import pretended
from clsplat.device.source import kernel_root, kernel_source
from clsplat.errors import reason_of
from clsplat.files.atomic import atomic_write
from clsplat.files.documents import parse_json
from clsplat.files.locks import briefly_locked
from clsplat.files.user_cache import cache_folder
from clsplat.version import package_version

BREAK_KERNEL_VARIABLE = "CLSPLAT_BREAK_KERNEL"
"""Environment variable for tests of `clsplat selftest` only. Its value, STEM: OLD => NEW, replaces words in the text of
STEM.cl, to simulate a driver that miscompiles an operation."""
MAX_DRIVER_RECORDS = 16
"""Maximum number of records in the file, one for each version of a driver. The latest are kept. Each has a few KiB."""


@dataclass(frozen=True)
class Entry:
    """The record of a driver in one kernel shape.

    stages: self-test stages that passed.
    kernels: names of the builds and launches that passed their trial, each with the salt (`Variant.anew`) of the build.
    failed: description of the driver's failure, or empty. When an entry is added to a record, None keeps the recorded
    failure.
    trial: if a build or launch failed, its name and all that `sandbox.again` needs to repeat it.
    """

    stages: frozenset[str] = frozenset()
    kernels: Mapping[str, str] = field(default_factory=dict)
    failed: str | None = ""
    trial: Mapping[str, Any] = field(default_factory=dict)


def memory_path() -> Path:
    """Return the path of the file with the driver records."""
    return cache_folder() / "drivers.json"


@lru_cache(maxsize=4)
def _kernels_digest(broken: str) -> str:
    texts = "".join(kernel_source(path.stem) for path in sorted(kernel_root().glob("*.cl")))
    return f"{zlib.crc32((texts + broken).encode()):08x}"


def device_key(device: cl.Device) -> str:
    """Return a key that identifies a device, its driver, and the capabilities that CLSPLAT_PRETEND sets."""
    words = [device.name.strip(), device.platform.version.strip(), device.driver_version.strip()]
    return " | ".join([*words, pretended()] if pretended() else words)


def driver_key(device: cl.Device) -> str:
    """Return the key of a driver's record, made from device, driver, version of clsplat and kernel sources."""
    kernels = _kernels_digest(os.environ.get(BREAK_KERNEL_VARIABLE, ""))
    return f"{device_key(device)} | clsplat {package_version()} {kernels}"


def _entry(value: object) -> Entry:
    """Parse an entry of the file of driver records. A value that clsplat never writes gives an empty entry."""
    given = value if isinstance(value, dict) else {}
    stages, kernels, failed = given.get("stages", []), given.get("kernels", {}), given.get("failed", "")
    trial = given.get("trial", {})
    if not (isinstance(stages, list) and isinstance(kernels, dict) and isinstance(trial, dict)):
        return Entry()
    if not all(isinstance(text, str) for text in (*stages, *kernels.values(), failed)):
        return Entry()
    return Entry(frozenset(stages), kernels, failed, trial)


_RECORDS_LOCK = threading.Lock()
"""Lock for `_unwritten`, because several devices may be used at the same time, each in a thread of its own."""
_unwritten: dict[Path, list[tuple[str, str, Entry]]] = {}
"""Entries that are not written yet, by the path of the file of records: driver key, shape label and entry of each."""


def _read() -> dict[str, Any]:
    """Return the contents of the file with the driver records, after the entries in `_unwritten` are added to them."""
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
    last = known if addition.failed is None else addition
    merged = {
        "stages": sorted(known.stages | addition.stages),
        "kernels": {**known.kernels, **addition.kernels},
        "failed": last.failed,
        "trial": last.trial if last.failed else {},
    }
    saved[driver] = {**shapes, shape: merged}


def entries(device: cl.Device) -> dict[str, Entry]:
    """Return the entries of the record of this device's driver, by shape label, such as 8x1."""
    shapes = _read().get(driver_key(device))
    return {name: _entry(value) for name, value in shapes.items()} if isinstance(shapes, dict) else {}


def entry(device: cl.Device, shape: str) -> Entry:
    """Return the entry of this device's driver for a shape label, such as 8x1; an empty entry if none is recorded."""
    return entries(device).get(shape, Entry())


def remember(
    device: cl.Device,
    shape: str,
    *,
    stages: Iterable[str] = (),
    kernels: Mapping[str, str] | None = None,
    failed: str | None = None,
    trial: Mapping[str, Any] | None = None,
) -> None:
    """Add results to the entry of this device's driver for a shape label, such as 8x1, and write the file.

    stages, kernels, failed, trial: as in `Entry`. failed: None keeps the recorded failure.

    If the file cannot be written, a warning says so, and each process tests drivers again.
    """
    path = memory_path()
    addition = Entry(frozenset(stages), kernels or {}, failed, trial or {})
    with _RECORDS_LOCK:
        _unwritten.setdefault(path, []).append((driver_key(device), shape, addition))
        try:
            rewrite(path, lambda: dict([*_read().items()][-MAX_DRIVER_RECORDS:]))
            del _unwritten[path]
        except OSError as error:
            tell_once(f"{path}: cannot be written ({reason_of(error)}), so drivers are tested again in each process")


def rewrite(path: Path, changed: Callable[[], Mapping[str, Any]]) -> None:
    """Write a JSON file, under a lock against other processes and threads. Raises OSError.

    changed: function that returns the new content of the file. It is called while the lock is held.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with briefly_locked(path):
        atomic_write(path, (json.dumps(changed(), indent=1) + "\n").encode())


@lru_cache(maxsize=8)
def tell_once(text: str) -> None:
    """Warn with this text, once per process."""
    warnings.warn(text, stacklevel=2)
