# SPDX-License-Identifier: Apache-2.0
"""Checkpoint files: writing, reading and verifying the arrays and the JSON state of a training, in a zip file.

`Trainer.checkpoint` decides what is in one; docs/architecture.md, "The run folder", lists it.
`runs/run.py` decides how many are kept (KEPT_CHECKPOINTS).
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO
from zipfile import ZIP_STORED, ZipFile

import numpy as np
from numpy.typing import NDArray

from clsplat.chunks.manifest import MANIFEST_ARRAYS, Manifest, manifest_of
from clsplat.errors import InputError, examples
from clsplat.files.atomic import atomic_writer
from clsplat.files.documents import open_input, parse_json
from clsplat.version import package_version

STATE_KEY = "state.json"
"""Zip member that holds a checkpoint's state, as JSON bytes. No array may have this name."""
NPY_MAGIC = b"\x93NUMPY\x01\x00"
"""First bytes of an array in np.save's format, version 1.0."""
NPY_HEADER = re.compile(
    r"\{'descr': '([<>|][biufc]\d{1,2})', 'fortran_order': (False|True), "
    r"'shape': \(((?:\d{1,18}(?:, \d{1,18}){0,7},?)?)\), \} *\n"
)
"""Pattern of the header that np.save writes before a numeric array. Groups: dtype, Fortran order, shape."""
Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Checkpoint:
    """Content of a checkpoint file.

    step: number of views that the training had used.
    arrays: arrays by name.
    state: JSON values by name.
    manifest: scratch file, slots and checksums of the Gaussians; None if the Gaussians are in `arrays`.
    """

    step: int
    arrays: Arrays
    state: dict[str, Any]
    manifest: Manifest | None = None

    def named(self, prefix: str) -> Arrays:
        """Arrays whose names start with `prefix`, keyed by the rest of their names."""
        return {name.removeprefix(prefix): array for name, array in self.arrays.items() if name.startswith(prefix)}


def unusable(checkpoint: Checkpoint, why: str) -> InputError:
    """Return the error for an intact checkpoint from which a training cannot continue. why: the reason."""
    advice = "is it from another run or version?"
    return InputError(f"checkpoint of step {checkpoint.step}: {why}; {advice}")


def digest_of(array: NDArray[Any]) -> str:
    """SHA-256 of an array's dtype, shape and values."""
    digest = hashlib.sha256(f"{array.dtype.str}{array.shape}".encode())
    digest.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def read_arrays(path: Path, expected: str) -> Arrays:
    """Read all numeric arrays of an np.savez file, by name.

    expected: name of the expected kind of file, for messages.
    Raises ValueError, InputError or an error of zipfile if the file is anything else. np.load is not used, because it
    trusts the array size in the header, and decompresses members.
    """
    arrays: Arrays = {}
    with open_input(path, expected) as file, ZipFile(_Bounded(file)) as archive:
        left = os.fstat(file.fileno()).st_size
        for member in archive.infolist():
            name = member.filename.removesuffix(".npy")
            left -= member.file_size
            if member.compress_type != ZIP_STORED or name == member.filename or name in arrays or left < 0:
                raise ValueError(f"its member {member.filename[:80]!r} does not belong to {expected}")
            arrays[name] = _array(archive.read(member), name)
    return arrays


def write_checkpoint(path: Path, step: int, arrays: Mapping[str, NDArray[Any]], state: Mapping[str, Any]) -> None:
    """Write a checkpoint atomically, with a digest of each array.

    arrays: arrays of any dtype except object.
    state: values that JSON can hold.
    """
    if STATE_KEY in arrays:
        raise ValueError(f"no array of a checkpoint may be called {STATE_KEY}")
    digests = {name: digest_of(array) for name, array in arrays.items()}
    text = json.dumps({"version": package_version(), "step": step, "sha256": digests, "state": dict(state)})
    members: Arrays = {STATE_KEY: np.frombuffer(text.encode(), np.uint8), **arrays}
    with atomic_writer(path, sum(array.nbytes + 512 for array in members.values())) as file:
        np.savez(file, allow_pickle=False, **members)


def read_checkpoint(path: Path, expected: int | None = None) -> Checkpoint:
    """Read a checkpoint, and check that its arrays are as `write_checkpoint` wrote them.

    expected: the step that the checkpoint must be of; None for any.
    Raises ValueError, InputError or an error of zipfile.
    """
    arrays = read_arrays(path, "a checkpoint")
    record = parse_json(arrays.pop(STATE_KEY).tobytes())
    if not isinstance(record, dict) or type(step := record.get("step")) is not int or step < 0:
        raise ValueError("its state has no step")
    if not isinstance(state := record.get("state"), dict):
        raise ValueError("its state is missing")
    digests = record.get("sha256")  # earlier versions wrote no digests
    if digests is not None:
        if not isinstance(digests, dict) or arrays.keys() != digests.keys():
            other = examples(sorted(arrays.keys() ^ set(digests)))[:200] if isinstance(digests, dict) else "no list"
            raise ValueError(f"its arrays differ from the arrays that were written ({other})")
        for name, array in arrays.items():
            if digest_of(array) != digests[name]:
                raise ValueError(f"array {name!r} has changed since it was written: its sha256 differs")
    if expected is not None and step != expected:
        raise ValueError(f"the file contains step {step}, but its name says step {expected}")
    return Checkpoint(step, arrays, state, manifest_of(arrays, state))


def scene_of(path: Path) -> str | None:
    """Return the digest of the scene that a checkpoint was trained on; None if not recorded, or the file is damaged."""
    try:
        scene = _part(path)[1].get("scene")
    except Exception:  # noqa: BLE001  # a damaged file raises any error; `load_latest_checkpoint` reports it
        return None
    return scene if isinstance(scene, str) else None


def read_manifest(path: Path) -> Manifest | None:
    """Read the manifest of a checkpoint; None if the Gaussians are among its arrays, or the file is damaged.

    Raises OSError if the file cannot be read now. The checkpoint may then be intact all the same, and need its scratch
    file.
    """
    try:
        return manifest_of(*_part(path, *MANIFEST_ARRAYS))
    except (OSError, MemoryError):
        raise
    except Exception:  # noqa: BLE001  # a damaged file raises any error; `load_latest_checkpoint` reports it
        return None


def _part(path: Path, *names: str) -> tuple[Arrays, dict[str, Any]]:
    """Read a checkpoint's state, and its arrays with these names. Digests are not checked."""
    arrays: Arrays = {}
    with open_input(path, "a checkpoint") as file, ZipFile(_Bounded(file)) as archive:
        for name in {*names, STATE_KEY} & {name.removesuffix(".npy") for name in archive.namelist()}:
            member = archive.getinfo(f"{name}.npy")
            if member.compress_type != ZIP_STORED:
                raise ValueError(f"its member {name!r} does not belong to a checkpoint")
            arrays[name] = _array(archive.read(member), name)
    state: dict[str, Any] = parse_json(arrays.pop(STATE_KEY).tobytes())["state"]
    return arrays, state


class _Bounded:
    """Open file whose `read` allocates no more memory than the remaining bytes of the file need.

    zipfile reads as many bytes as headers claim, and Python's `read` allocates the whole size that is asked for.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._size = file, os.fstat(file.fileno()).st_size
        self.seek, self.tell, self.seekable = file.seek, file.tell, file.seekable

    def read(self, size: int = -1) -> bytes:
        left = max(self._size - self.tell(), 0)
        return self._file.read(left if size < 0 else min(size, left))


def _array(data: bytes, name: str) -> NDArray[Any]:
    """Parse a numeric array in np.save's format. Raises ValueError. name: name of the array, for messages."""
    length = int.from_bytes(data[8:10], "little")
    text = data[10 : 10 + length].decode("latin-1")
    match = NPY_HEADER.fullmatch(text) if data[:8] == NPY_MAGIC else None
    if match is None:
        raise ValueError(f"its member {name[:80]!r} is not a numeric array")
    kind, shape = np.dtype(match[1]), tuple(int(size) for size in match[3].split(",") if size.strip())
    body = data[10 + length :]
    if math.prod(shape) * kind.itemsize != len(body):
        raise ValueError(f"its array {name[:80]!r} has {len(body)} bytes, expected {shape} of {kind}")
    array = np.frombuffer(bytearray(body), kind)  # a copy, because np.frombuffer on bytes is read-only
    return array.reshape(shape, order="F" if match[2] == "True" else "C")
