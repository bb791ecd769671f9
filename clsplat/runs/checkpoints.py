# SPDX-License-Identifier: Apache-2.0
"""Checkpoints: arrays in a file that is checked before it is used."""

from __future__ import annotations

import hashlib
import math
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO
from zipfile import ZIP_STORED, ZipFile

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError, examples
from clsplat.files import open_input, parse_json

STATE_KEY = "state.json"
"""The member of a checkpoint that holds its state, as JSON bytes; no array may have this name."""
NPY_MAGIC = b"\x93NUMPY\x01\x00"
NPY_HEADER = re.compile(
    r"\{'descr': '([<>|][biufc]\d{1,2})', 'fortran_order': (False|True), "
    r"'shape': \(((?:\d{1,18}(?:, \d{1,18}){0,7},?)?)\), \} *\n"
)
"""The text that np.save writes before an array of numbers."""
Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Checkpoint:
    """step: optimisation steps done; arrays by name; state: JSON values."""

    step: int
    arrays: Arrays
    state: dict[str, Any]

    def named(self, prefix: str) -> Arrays:
        """Arrays whose names begin so, by the rest of their names."""
        return {name.removeprefix(prefix): array for name, array in self.arrays.items() if name.startswith(prefix)}


def unusable(checkpoint: Checkpoint, why: str) -> InputError:
    """The error of a checkpoint that is whole, and not one to go on with."""
    advice = "is it of another run or version?"
    return InputError(f"checkpoint of step {checkpoint.step}: {why}; {advice}")


def digest_of(array: NDArray[Any]) -> str:
    """Digest of an array's dtype, shape and values."""
    digest = hashlib.sha256(f"{array.dtype.str}{array.shape}".encode())
    digest.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def read_arrays(path: Path, expected: str) -> Arrays:
    """The arrays of numbers of a file that np.savez has made, by name. `expected` as of `open_input`.

    Raises ValueError, InputError or what zipfile does where it is no such file. Not by np.load, which takes an array's
    size from its header, and unpacks what was packed.
    """
    arrays: Arrays = {}
    with open_input(path, expected) as file, ZipFile(_Bounded(file)) as archive:
        left = os.fstat(file.fileno()).st_size
        for member in archive.infolist():
            name = member.filename.removesuffix(".npy")
            left -= member.file_size
            if member.compress_type != ZIP_STORED or name == member.filename or name in arrays or left < 0:
                raise ValueError(f"its member {member.filename[:80]!r} is none of {expected}'s")
            arrays[name] = _array(archive.read(member), name)
    return arrays


def read_checkpoint(path: Path, expected: int) -> Checkpoint:
    """Raises ValueError, InputError or what zipfile does where it is not as `save_checkpoint` makes it of that step."""
    arrays = read_arrays(path, "a checkpoint")
    record = parse_json(arrays.pop(STATE_KEY).tobytes())
    if not isinstance(record, dict) or type(step := record.get("step")) is not int or step < 0:
        raise ValueError("its state names no step")
    if not isinstance(state := record.get("state"), dict):
        raise ValueError("its state is none")
    digests = record.get("sha256")  # runs of earlier versions have none
    if digests is not None:
        if not isinstance(digests, dict) or arrays.keys() != digests.keys():
            other = examples(sorted(arrays.keys() ^ set(digests)))[:200] if isinstance(digests, dict) else "no list"
            raise ValueError(f"it has not the arrays it was written with ({other})")
        for name, array in arrays.items():
            if digest_of(array) != digests[name]:
                raise ValueError(f"{name} is not what was written: its sha256 differs")
    if step != expected:
        raise ValueError(f"it is of step {step}")
    return Checkpoint(step, arrays, state)


def scene_of(path: Path) -> str | None:
    """The digest of the scene that a checkpoint's state names; None where it names none, or is damaged."""
    try:
        with open_input(path, "a checkpoint") as file, ZipFile(_Bounded(file)) as archive:
            member = archive.getinfo(f"{STATE_KEY}.npy")
            if member.compress_type != ZIP_STORED:
                return None
            scene = parse_json(_array(archive.read(member), STATE_KEY).tobytes())["state"].get("scene")
            return scene if isinstance(scene, str) else None
    except Exception:  # noqa: BLE001  # as of load_latest_checkpoint, which tells of it
        return None


class _Bounded:
    """A file that is never asked for more than it has: `read` makes room for all that it is asked for, and zipfile asks
    for what a header says."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._size = file, os.fstat(file.fileno()).st_size
        self.seek, self.tell, self.seekable = file.seek, file.tell, file.seekable

    def read(self, size: int = -1) -> bytes:
        left = max(self._size - self.tell(), 0)
        return self._file.read(left if size < 0 else min(size, left))


def _array(data: bytes, name: str) -> NDArray[Any]:
    """An array of numbers as np.save writes it. Raises ValueError."""
    length = int.from_bytes(data[8:10], "little")
    text = data[10 : 10 + length].decode("latin-1")
    match = NPY_HEADER.fullmatch(text) if data[:8] == NPY_MAGIC else None
    if match is None:
        raise ValueError(f"its member {name[:80]!r} is no array of numbers")
    kind, shape = np.dtype(match[1]), tuple(int(size) for size in match[3].split(",") if size.strip())
    body = data[10 + length :]
    if math.prod(shape) * kind.itemsize != len(body):
        raise ValueError(f"its array {name[:80]!r} has {len(body)} bytes, expected {shape} of {kind}")
    array = np.frombuffer(bytearray(body), kind)  # of its own, to be written to
    return array.reshape(shape, order="F" if match[2] == "True" else "C")
