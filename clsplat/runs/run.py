# SPDX-License-Identifier: Apache-2.0
"""The run folder: config.toml, model.ply, metrics.jsonl, eval.json, checkpoints/, test/ (held-out renders). What is in
scene.json `clsplat.runs.scene_record` knows."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, is_dataclass
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, Literal, TypeVar, get_args, get_origin, get_type_hints
from zipfile import ZIP_STORED, ZipFile

import numpy as np
import tomli_w
from numpy.typing import NDArray

import clsplat
from clsplat.config.training import TrainConfig
from clsplat.errors import ClsplatError, InputError, examples, plain
from clsplat.files import (
    TEMPORARY_SUFFIX,
    atomic_write,
    atomic_writer,
    open_input,
    parse_json,
    read_document,
    remove,
    write_error,
)
from clsplat.gaussians import Gaussians
from clsplat.runs.locks import locked

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

KEPT_CHECKPOINTS = 2
MAX_SETTINGS, MAX_METRICS, MAX_LINE = 1 << 20, 64 << 20, 1 << 16
"""Bytes of config.toml, of metrics.jsonl, hundreds of times what the longest training writes, and of a line of it."""
STATE_KEY = "state.json"
"""The member of a checkpoint that holds its state, as JSON bytes; no array may have this name."""

NPY_MAGIC = b"\x93NUMPY\x01\x00"
NPY_HEADER = re.compile(
    r"\{'descr': '([<>|][biufc]\d{1,2})', 'fortran_order': (False|True), "
    r"'shape': \(((?:\d{1,18}(?:, \d{1,18}){0,7},?)?)\), \} *\n"
)
"""What np.save writes before an array of numbers."""

Arrays = dict[str, NDArray[Any]]
T = TypeVar("T")

RETIRED: dict[str, Any] = {"train.rasterizer.sh_angle": 0.0}
"""Settings that earlier versions had, and the value of each with which it did nothing."""


@dataclass(frozen=True)
class Checkpoint:
    """step: optimisation steps done; arrays by name; state: JSON values."""

    step: int
    arrays: Arrays
    state: dict[str, Any]


class Run:
    """A run folder. Make one with `Run.create`, open one that is there with `Run.open`."""

    def __init__(self, path: Path, config: TrainConfig, scene: Path | None, *, resuming: bool = False) -> None:
        self.path, self.config, self.scene, self.resuming = path, config, scene, resuming
        self.config_path = path / "config.toml"
        self.model_path = path / "model.ply"
        self.metrics_path = path / "metrics.jsonl"
        self.eval_path = path / "eval.json"
        self.checkpoints_path = path / "checkpoints"
        self.test_path = path / "test"

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        config: TrainConfig,
        *,
        scene: str | os.PathLike[str] | None = None,
        resume: bool = False,
        overwrite: bool = False,
    ) -> Run:
        """Make the folder and its config.toml; `scene` is recorded there as an absolute path.

        resume: go on in a run that is there, with `config` (see `check_resumed`); overwrite: remove the files of the
        run that is there, and nothing else. Raises InputError where `check_output` and `locks.locked` do.
        """
        path = Path(path)
        check_output(path, resume=resume, overwrite=overwrite)
        path.mkdir(parents=True, exist_ok=True)
        with locked(path, "train"):
            check_output(path, resume=resume, overwrite=overwrite)  # again: another process may just have been there
            if resume:
                earlier = cls.open(path)
                check_resumed(earlier, config)
                if (was := earlier.config.background) != config.background:
                    warnings.warn(
                        plain(f"{path}: the background was {was} so far and is {config.background} from here on: ")
                        + "Gaussians that stand for the old one have to be learnt anew",
                        stacklevel=2,
                    )
                scene = scene or earlier.scene
            elif overwrite and is_run(path):
                for file in owned_files(path):
                    remove(file)
            run = cls(path, config, Path(scene).absolute() if scene is not None else None, resuming=resume)
            run.checkpoints_path.mkdir(exist_ok=True)
            atomic_write(run.config_path, config_text(config, run.scene).encode())
        return run

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Run:
        """A run that is there. Raises InputError where it is none or its config.toml is wrong."""
        path = Path(path)
        if not path.is_dir():
            raise InputError(f"{path}: no such folder, expected a run")
        if not is_run(path):
            raise InputError(f"{path}: not a run (no config.toml of clsplat in it)")
        config, scene = read_config(path / "config.toml")
        return cls(path, config, scene)

    def keep_config(self, config: TrainConfig) -> None:
        """Write config.toml where the settings are others than those there."""
        if config != self.config:
            atomic_write(self.config_path, config_text(config, self.scene).encode())
            self.config = config

    def save_model(self, gaussians: Gaussians, space: str = "sRGB") -> None:
        """Write model.ply; space: the colour space that it was trained in (`colour.photos_space`)."""
        from clsplat.images.colour import comment

        gaussians.save(self.model_path, comments=[comment(space)])

    def write_eval(self, result: Mapping[str, Any]) -> None:
        """Write eval.json."""
        atomic_write(self.eval_path, (json.dumps(result, indent=2, allow_nan=False) + "\n").encode())

    def model_record(self) -> dict[str, Any]:
        """`step` and `seconds` of model.ply, where they are known.

        From eval.json, which is written after the model: a run that was resumed and stopped has later metrics. An
        older eval.json is of the model before, as when the evaluation was interrupted.
        """
        with suppress(OSError, ValueError, InputError):
            if self.eval_path.stat().st_mtime_ns < self.model_path.stat().st_mtime_ns:
                raise ValueError("of an earlier model")
            record = parse_json(read_document(self.eval_path, "the evaluation of a run"))
            if isinstance(record, dict) and type(record.get("step")) is int:
                return record
        return next(reversed(self.read_metrics()), {})

    def append_metrics(self, record: Mapping[str, Any]) -> None:
        """Add a line to metrics.jsonl, out of the program at once. Raises ClsplatError for a number not finite."""
        try:
            line = json.dumps(record, allow_nan=False)
        except ValueError:
            raise ClsplatError(f"training diverged at step {record.get('step')}: {dict(record)}") from None
        try:
            with open(self.metrics_path, "a", encoding="utf-8", newline="\n") as file:
                file.write(line + "\n")
        except OSError as error:  # a full disk does not say which file it was
            raise write_error(self.metrics_path, error, needs=len(line) + 1) from None

    def read_metrics(self) -> list[dict[str, Any]]:
        """The records of metrics.jsonl; a cut last line, as a crash leaves it, is left out."""
        return [record for _, record in self._metrics_lines()]

    def truncate_metrics(self, step: int) -> None:
        """Drop the records of later steps, and a cut last line."""
        if self.metrics_path.exists():
            kept = [line for line, record in self._metrics_lines() if record.get("step", 0) <= step]
            atomic_write(self.metrics_path, "".join(line + "\n" for line in kept).encode())

    def _metrics_lines(self) -> Iterator[tuple[str, dict[str, Any]]]:
        if not self.metrics_path.exists():
            return
        with open_input(self.metrics_path, "the metrics of a run") as file:
            if (size := os.fstat(file.fileno()).st_size) > MAX_METRICS:
                raise InputError(f"{self.metrics_path}: has {size} bytes, expected at most {MAX_METRICS}")
            while data := file.readline(MAX_LINE):
                with suppress(ValueError):
                    line = data.decode("utf-8").rstrip("\r\n")
                    record = parse_json(line)
                    if isinstance(record, dict) and type(record.get("step", 0)) in (int, float):
                        yield line, record

    def save_checkpoint(self, step: int, arrays: Mapping[str, NDArray[Any]], state: Mapping[str, Any]) -> Path:
        """Write checkpoints/step-STEP.npz atomically and keep the latest two.

        arrays: any dtype but object; state: what JSON holds. The digest of each array is kept with the state.
        Checkpoints of later steps are removed: training has gone back before them.
        """
        if STATE_KEY in arrays:
            raise ValueError(f"no array of a checkpoint may be called {STATE_KEY}")
        digests = {name: _digest(array) for name, array in arrays.items()}
        text = json.dumps({"version": clsplat.__version__, "step": step, "sha256": digests, "state": dict(state)})
        self.checkpoints_path.mkdir(parents=True, exist_ok=True)
        path = self.checkpoints_path / f"step-{step:07d}.npz"
        members: Arrays = {STATE_KEY: np.frombuffer(text.encode(), np.uint8), **arrays}
        with atomic_writer(path, sum(array.nbytes + 512 for array in members.values())) as file:
            np.savez(file, allow_pickle=False, **members)
        earlier = [(s, p) for s, p in self.checkpoints() if s <= step]
        keep = {p for _, p in earlier[-KEPT_CHECKPOINTS:]}
        for _, other in self.checkpoints():
            if other not in keep:
                remove(other)
        return path

    def checkpoints(self) -> list[tuple[int, Path]]:
        """Step and path of every checkpoint, by step."""
        found = [(re.fullmatch(r"step-(\d+)\.npz", path.name), path) for path in self.checkpoints_path.glob("*.npz")]
        return sorted((int(match[1]), path) for match, path in found if match)

    def load_latest_checkpoint(self) -> Checkpoint | None:
        """The latest checkpoint that is whole; None where there is none at all.

        A damaged one gives a warning and the one before it is taken; with none left, InputError. In a run that
        resumes, metrics.jsonl is cut back to the checkpoint's step, and what a killed process left half-written is
        removed.
        """
        found = self.checkpoints()
        checkpoint: Checkpoint | None = None
        for step, path in reversed(found):
            try:
                checkpoint = _read_checkpoint(path)
                if checkpoint.step != step:
                    found_step, checkpoint = checkpoint.step, None
                    raise ValueError(f"it is of step {found_step}")
                break
            except Exception as error:  # noqa: BLE001  # zipfile and NumPy raise nearly anything for a flipped bit
                why = str(error) or type(error).__name__
                warnings.warn(plain(f"{path}: checkpoint is damaged and was passed over ({why})"), stacklevel=2)
        if found and checkpoint is None:
            raise InputError(f"{self.checkpoints_path}: no checkpoint there is whole, use --overwrite to start again")
        if checkpoint is None and (lost := max((each.get("step", 0) for each in self.read_metrics()), default=0)):
            warnings.warn(
                plain(f"{self.path}: has no checkpoint: training begins again, the {lost} steps before are lost"),
                stacklevel=2,
            )
        if self.resuming:
            for left in self.path.rglob(".*" + TEMPORARY_SUFFIX):
                remove(left)
            self.truncate_metrics(checkpoint.step if checkpoint else 0)
        return checkpoint


def _digest(array: NDArray[Any]) -> str:
    """Of what an array is and holds."""
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


def _read_checkpoint(path: Path) -> Checkpoint:
    """Raises ValueError, InputError or what zipfile does where it is not as `save_checkpoint` makes it."""
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
            if _digest(array) != digests[name]:
                raise ValueError(f"{name} is not what was written: its sha256 differs")
    return Checkpoint(step, arrays, state)


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


def model_file(path: Path) -> Path:
    """The model file that a run's folder, a folder of a format that is one, or the path of a file means. Raises
    InputError for a run without one."""
    from clsplat.models.formats import model_path

    if not path.is_dir():
        return path
    if not is_run(path) and (found := model_path(path)) != path:
        return found
    trained = Run.open(path)
    if not trained.model_path.exists():
        raise InputError(f"{trained.model_path}: no such file, the run has not written its model yet")
    return trained.model_path


def is_run(path: Path) -> bool:
    """Whether the folder holds a config.toml that clsplat wrote."""
    try:
        text = read_document(path / "config.toml", "the settings of a run", MAX_SETTINGS)
    except InputError:
        return False
    return any(line.startswith("clsplat = ") for line in text.split("\n"))


def check_output(path: Path, *, resume: bool, overwrite: bool) -> None:
    """Raise InputError where a run may not be put at `path`. Writes nothing."""
    if resume and overwrite:
        raise InputError("--resume and --overwrite exclude each other")
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file, expected a folder for the run")
    if resume and not is_run(path):
        raise InputError(f"{path}: no run to resume there (no config.toml of clsplat)")
    if is_run(path):
        if not (resume or overwrite):
            raise InputError(f"{path}: is already a run, use --resume to go on with it or --overwrite to replace it")
    elif path.is_dir():
        foreign = sorted(entry.name for entry in path.iterdir() if not entry.name.startswith("."))
        if foreign:
            raise InputError(f"{path}: holds other files ({foreign[0]}) and is no run, expected an empty or new folder")


def owned_files(path: Path) -> list[Path]:
    """The files in a run's folder that clsplat wrote, and that --overwrite may therefore remove."""
    patterns = ("checkpoints/step-*.npz", "trouble-step-*.npz", "test/**/*.png", "**/.*" + TEMPORARY_SUFFIX)
    # config.toml last: a removal that is cut short still leaves a run, which --overwrite can remove.
    names = ("model.ply", "metrics.jsonl", "eval.json", "report.html", "scene.json", "config.toml")
    found = [file for pattern in patterns for file in sorted(path.glob(pattern))] + [path / name for name in names]
    return [file for file in found if file.is_file() or file.is_symlink()]


def check_resumed(earlier: Run, config: TrainConfig) -> None:
    """Raise InputError where `config` changes what a run cannot change on its way."""
    for name in ("sh_degree", "seed", "test_every"):
        was, now = getattr(earlier.config, name), getattr(config, name)
        if was != now:
            raise InputError(f"{earlier.config_path}: {name} is {was} there, a resumed run cannot change it to {now}")


def config_text(config: TrainConfig, scene: Path | None) -> str:
    """The content of config.toml."""
    document: dict[str, Any] = {"clsplat": clsplat.__version__}
    if scene is not None:
        document["scene"] = str(scene)
    document["train"] = _of_python(asdict(config))
    return tomli_w.dumps(document)


def _of_python(value: Any) -> Any:
    """Settings without NumPy's numbers, which TOML does not know."""
    if isinstance(value, dict):
        return {key: _of_python(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_of_python(each) for each in value]
    return value.item() if isinstance(value, np.generic) else value


def read_config(path: Path) -> tuple[TrainConfig, Path | None]:
    """The configuration and the scene's path. Raises InputError naming the file and the key that is wrong."""
    return parse_config(read_document(path, "the settings of a run", MAX_SETTINGS), path)


def parse_config(text: str, path: Path, *, tell: bool = True) -> tuple[TrainConfig, Path | None]:
    """As `read_config`, of the file's text; tell: warn of settings that there are no more."""
    try:
        document = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not readable as TOML ({error})") from None
    for key in document:
        if key not in ("clsplat", "scene", "train"):
            raise InputError(
                f"{path}: has {key!r}, which is no setting; expected clsplat, scene and the tables of train"
            )
    scene = document.get("scene")
    if scene is not None and not (isinstance(scene, str) and scene):
        raise InputError(f"{path}: scene is {scene!r}, expected the scene's path as text")
    config = _from_table(TrainConfig, document.get("train", {}), path, "train", tell=tell)
    try:
        config.check()
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return config, Path(scene) if scene is not None else None


def _from_table(cls: type[T], table: Any, path: Path, where: str, *, tell: bool) -> T:
    """An instance of the dataclass `cls`; keys that are not there keep their defaults."""
    if not isinstance(table, dict):
        raise InputError(f"{path}: {where} is {table!r}, expected a table")
    types = get_type_hints(cls)
    names = [f.name for f in fields(cls)]  # type: ignore[arg-type]  # every caller passes a dataclass
    values = {}
    for key, value in table.items():
        if (name := f"{where}.{key}") in RETIRED:
            if value != RETIRED[name] and tell:
                _tell_retired(path, name, repr(value))
            continue
        if key not in names:
            raise InputError(f"{path}: [{where}] has {key!r}, which is no setting there; {_meant(key, where)}")
        if is_dataclass(types[key]):
            values[key] = _from_table(types[key], value, path, f"{where}.{key}", tell=tell)
        else:
            values[key] = _value(types[key], value, f"{path}: {where}.{key}")
    return cls(**values)


def _meant(key: str, where: str) -> str:
    """Where a setting of that name, or one like it, belongs."""
    tables = {"train": TrainConfig} | {
        f"train.{name}": kind for name, kind in get_type_hints(TrainConfig).items() if is_dataclass(kind)
    }
    places = {f.name: table for table, kind in reversed(tables.items()) for f in fields(kind)}
    if key in places:
        return f"it belongs to [{places[key]}]"
    here = [name for name, table in places.items() if table == where]
    near = get_close_matches(key, here, 1) or get_close_matches(key, places, 1)
    if near:
        return f"did you mean {near[0]!r} in [{places[near[0]]}]?"
    return "take it out: was it written by another version?"


@cache
def _tell_retired(path: Path, name: str, value: str) -> None:
    """A warning, once for a file however often it is read."""
    warnings.warn(plain(f"{path}: {name} is {value} there and is passed over, this version has no such setting"))


def _value(kind: Any, value: Any, what: str) -> Any:
    """`value`, as TOML gives it, for a field of type `kind`."""
    if get_origin(kind) is Literal:
        if value in get_args(kind):
            return value
        raise InputError(f"{what} is {value!r}, expected one of {', '.join(map(str, get_args(kind)))}")
    if get_origin(kind) is tuple:
        if isinstance(value, list):
            return tuple(_value(get_args(kind)[0], item, what) for item in value)
    elif kind is float and isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300:
        return float(value)
    elif type(value) is kind and not (kind is int and abs(value) >= 1 << 62):
        return value
    words = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}
    raise InputError(f"{what} is {value!r}, expected {words.get(kind, 'a list of whole numbers')}")
