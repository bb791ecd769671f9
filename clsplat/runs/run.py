# SPDX-License-Identifier: Apache-2.0
"""The run folder: config.toml, model.ply, metrics.jsonl, eval.json, checkpoints/ and test/ (held-out renders).

`clsplat.runs.scene_record` reads and writes scene.json. `clsplat.runs.settings` reads and writes config.toml, and has
the size limits of these files.
"""

from __future__ import annotations

import json
import os
import re
import shlex
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.chunks.manifest import Manifest
from clsplat.chunks.store import ChunkStore
from clsplat.config.orientation import AS_IN_FILES, FrameUse
from clsplat.config.training import TrainConfig
from clsplat.errors import ClsplatError, InputError, warn
from clsplat.files.atomic import TEMPORARY_SUFFIX, atomic_write, atomic_writer, remove, write_error
from clsplat.files.documents import is_settings_of_run, open_input, parse_json, read_document
from clsplat.gaussians import Gaussians
from clsplat.images.colour import comment
from clsplat.models.formats import model_path, ply
from clsplat.runs.checkpoints import Checkpoint, read_checkpoint, read_manifest, write_checkpoint
from clsplat.runs.locks import locked
from clsplat.runs.settings import (
    MAX_METRICS_BYTES,
    MAX_METRICS_LINE_BYTES,
    config_text,
    read_config,
)
from clsplat.scenes.dataset import SOURCE_FRAME, SceneFrame
from clsplat.scenes.geography.georeference import GEOREFERENCE_FILE
from clsplat.scenes.orientation.frame_record import FRAME_RECORD_FILE, read_frame
from clsplat.scenes.sfm.video_frames import reconstruction_folder

APPEARANCE_FILE = "appearance.json"
"""Name of the file with the photographs' learnt appearance, in a run's folder."""
KEPT_CHECKPOINTS = 2
"""Number of latest checkpoints that a run keeps."""
SCRATCH_SUFFIX = ".chunks"
"""Ending of the names of scratch files, which contain chunks of a model."""
OWNER_DIGITS = 12
"""Number of hexadecimal digits in a scratch file's name that identify its run."""
SCRATCH_NAME = re.compile(rf"[0-9a-f]{{{OWNER_DIGITS}}}-[0-9a-f]{{8}}{re.escape(SCRATCH_SUFFIX)}")
"""Name of a scratch file: digits of its run, then random digits (`runs.scratch`)."""


class Run:
    """A run folder. `Run.create` makes one, `Run.open` opens an existing one.

    scene: path of the scene; None if config.toml does not record it.
    resuming: True if training continues an earlier run in this folder.
    scratch_path: folder of the scratch files, which may be outside the run folder.
    """

    def __init__(self, path: Path, config: TrainConfig, scene: Path | None, *, resuming: bool = False) -> None:
        self.path, self.config, self.scene, self.resuming = path, config, scene, resuming
        self.config_path = path / "config.toml"
        self.model_path = path / "model.ply"
        self.metrics_path = path / "metrics.jsonl"
        self.eval_path = path / "eval.json"
        self.appearance_path = path / APPEARANCE_FILE
        self.depth_path = path / "depth"
        self.refined_path = path / "refined"
        self.checkpoints_path = path / "checkpoints"
        self.test_path = path / "test"
        self.cache_path = path / "cache"
        self.scratch_path = path / "scratch"
        self._intact: int | None = None
        """Step of the latest checkpoint that has been written or verified."""
        self.resume_command = shlex.join(["clsplat", "train", "-o", str(path), "--resume"])

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        config: TrainConfig,
        *,
        scene: str | os.PathLike[str] | None = None,
        resume: bool = False,
        overwrite: bool = False,
        beside: Collection[str] = (),
    ) -> Run:
        """Make the run folder and its config.toml, which records `scene` as an absolute path.

        resume: continue an existing run with `config` (see `check_resumed`).
        overwrite: remove the files of an existing run, and nothing else.
        beside: names of other files and folders that may be in the folder.
        Raises InputError like `check_output`, `check_resumed` and `locks.locked`.
        """
        path = Path(path)
        check_output(path, resume=resume, overwrite=overwrite, beside=beside)
        path.mkdir(parents=True, exist_ok=True)
        with locked(path, "train"):
            # check again, because another process may have made a run
            check_output(path, resume=resume, overwrite=overwrite, beside=beside)
            if resume:
                earlier = cls.open(path)
                check_resumed(earlier, config)
                if (was := earlier.config.background) != config.background:
                    warn(
                        f"{path}: the background was {was} so far and is {config.background} from here on; "
                        "Gaussians that imitate the old background have to be learnt anew"
                    )
                scene = scene or earlier.scene
            elif overwrite and is_run(path):
                for file in owned_files(path):
                    remove(file)
            run = cls(path, config, Path(scene).absolute() if scene is not None else None, resuming=resume)
            # first, so that a folder in which the disk became full is a run, and the same command goes on
            atomic_write(run.config_path, config_text(config, run.scene).encode())
            run.checkpoints_path.mkdir(exist_ok=True)
        return run

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Run:
        """Open an existing run. Raises InputError if the folder is not a run or its config.toml is wrong."""
        path = Path(path)
        if not path.is_dir():
            raise InputError(f"{path}: no such folder, expected a run")
        if not is_run(path):
            raise InputError(f"{path}: is not a run (no config.toml of clsplat in it)")
        config, scene = read_config(path / "config.toml")
        return cls(path, config, scene)

    @property
    def frame(self) -> SceneFrame | None:
        """Frame of the run's scene and model, from frame.json; None without this file. Raises InputError."""
        return read_frame(self.path) if (self.path / FRAME_RECORD_FILE).exists() else None

    def is_scene(self, path: Path) -> bool:
        """True if `path` is the run's scene, or its reconstruction by structure from motion."""
        if self.scene is None:
            return False
        own, other = self.scene.resolve(), path.resolve()
        return other in (own, reconstruction_folder(own))

    def frame_for(self, path: Path) -> FrameUse | SceneFrame:
        """Return the frame in which a scene or its cameras fit the model: the model's frame for the run's own scene.

        The scene's files may have been turned since the training. Other scenes keep the frame of their files. Raises
        InputError for a damaged frame.json.
        """
        if not self.is_scene(path):
            return AS_IN_FILES
        return self.frame or SOURCE_FRAME

    def frame_to_resume(self) -> FrameUse | SceneFrame:
        """Return the frame in which a training goes on: the model's, or before the first checkpoint the settings'.

        Raises InputError for a damaged frame.json.
        """
        return self.frame or (SOURCE_FRAME if self.checkpoints() else self.config.frame_use)

    def keep_config(self, config: TrainConfig) -> None:
        """Write config.toml if the settings in `config` differ from the settings in the file."""
        if config != self.config:
            atomic_write(self.config_path, config_text(config, self.scene).encode())
            self.config = config

    def save_model(self, gaussians: Gaussians, space: str = "sRGB") -> None:
        """Write model.ply.

        space: the colour space that the model was trained in (`colour.photos_space`).
        """
        gaussians.save(self.model_path, comments=[comment(space)])

    def save_model_rows(
        self, model: Gaussians, count: int, rows: Callable[[int, int], Gaussians], space: str = "sRGB"
    ) -> None:
        """Write model.ply of a model that is not in memory as a whole.

        model: Gaussians with the origin, near plane, SH degree and other properties of the whole model.
        count: number of Gaussians of the whole model.
        rows: function that returns the Gaussians [start, stop).
        space: the colour space that the model was trained in.
        """
        ply.write_rows(self.model_path, model, count, rows, comments=[comment(space)])

    def write_eval(self, result: Mapping[str, Any]) -> None:
        """Write `result`, the scores of the held-out views, to eval.json."""
        atomic_write(self.eval_path, (json.dumps(result, indent=2, allow_nan=False) + "\n").encode())

    def write_appearance(self, record: Mapping[str, Any], tables: Mapping[str, NDArray[Any]] | None = None) -> None:
        """Write `record` to appearance.json, and `tables`, arrays too large for JSON, to appearance.npz."""
        if tables:
            with atomic_writer(self.appearance_path.with_suffix(".npz")) as file:
                np.savez(file, **dict[str, Any](tables))
        atomic_write(self.appearance_path, (json.dumps(record, indent=2, allow_nan=False) + "\n").encode())

    @property
    def result_files(self) -> list[Path]:
        """Files of the trained model and of the learnt appearance, which a finished training has written."""
        return [self.model_path, *self.appearance_files]

    @property
    def appearance_files(self) -> list[Path]:
        """Files of the learnt appearance; none if the settings learn no appearance."""
        if self.config.appearance == "none":
            return []
        tables = [self.appearance_path.with_suffix(".npz")] if self.config.appearance == "grid" else []
        return [self.appearance_path, *tables]

    def model_record(self) -> dict[str, Any]:
        """Return a record with the `step` and `seconds` of model.ply; empty if they are not known.

        The record is eval.json, which is written after the model. If eval.json is not usable, or older than the model,
        the record is the last of metrics.jsonl. This may be of a later step than the model, if the run was resumed and
        then stopped.
        """
        with suppress(OSError, ValueError, InputError):
            if self.eval_path.stat().st_mtime_ns < self.model_path.stat().st_mtime_ns:
                raise ValueError("eval.json is older than model.ply")
            record = parse_json(read_document(self.eval_path, "the evaluation of a run"))
            if isinstance(record, dict) and type(record.get("step")) is int:
                return record
        return next(reversed(self.read_metrics()), {})

    def append_metrics(self, record: Mapping[str, Any]) -> None:
        """Append a line to metrics.jsonl and flush it. Raises ClsplatError for a number that is not finite."""
        try:
            line = json.dumps(record, allow_nan=False)
        except ValueError:
            step = record.get("step")
            raise ClsplatError(f"training diverged at step {step}: a value is not finite: {dict(record)}") from None
        try:
            with open(self.metrics_path, "a", encoding="utf-8", newline="\n") as file:
                file.write(line + "\n")
        except OSError as error:  # the system's error for a full disk does not name the file
            raise write_error(self.metrics_path, error, needs=len(line) + 1) from None

    def read_metrics(self) -> list[dict[str, Any]]:
        """Return the records of metrics.jsonl, without an incomplete last line, which a crash may leave."""
        return [record for _, record in self._metrics_lines()]

    def truncate_metrics(self, step: int) -> None:
        """Drop the records of metrics.jsonl that are of later steps than `step`, and an incomplete last line."""
        if self.metrics_path.exists():
            kept = [line for line, record in self._metrics_lines() if record.get("step", 0) <= step]
            atomic_write(self.metrics_path, "".join(line + "\n" for line in kept).encode())

    def _metrics_lines(self) -> Iterator[tuple[str, dict[str, Any]]]:
        if not self.metrics_path.exists():
            return
        with open_input(self.metrics_path, "the metrics of a run") as file:
            if (size := os.fstat(file.fileno()).st_size) > MAX_METRICS_BYTES:
                raise InputError(f"{self.metrics_path}: has {size} bytes, expected at most {MAX_METRICS_BYTES}")
            while data := file.readline(MAX_METRICS_LINE_BYTES):
                with suppress(ValueError):
                    line = data.decode("utf-8").rstrip("\r\n")
                    record = parse_json(line)
                    if isinstance(record, dict) and type(record.get("step", 0)) in (int, float):
                        yield line, record

    def save_checkpoint(self, step: int, arrays: Mapping[str, NDArray[Any]], state: Mapping[str, Any]) -> Path:
        """Write checkpoints/step-STEP.npz atomically and keep the latest two.

        arrays, state: arrays and JSON values by name, the content of the checkpoint.
        Checkpoints of later steps are removed, because training has gone back to an earlier step.
        """
        self.checkpoints_path.mkdir(parents=True, exist_ok=True)
        path = self.checkpoints_path / f"step-{step:07d}.npz"
        write_checkpoint(path, step, arrays, state)
        self._intact = step
        earlier = [(s, p) for s, p in self.checkpoints() if s <= step]
        keep = {p for _, p in earlier[-KEPT_CHECKPOINTS:]}
        for _, other in self.checkpoints():
            if other not in keep:
                remove(other)
        return path

    def checkpoints(self) -> list[tuple[int, Path]]:
        """Step and path of every checkpoint, in the order of the steps."""
        matches = [(re.fullmatch(r"step-(\d+)\.npz", path.name), path) for path in self.checkpoints_path.glob("*.npz")]
        return sorted((int(match[1]), path) for match, path in matches if match)

    def manifests(self) -> list[tuple[Path, Manifest]]:
        """Return paths and manifests of the checkpoints whose Gaussians are in scratch files, the earliest first.

        Damaged checkpoints are left out, and those of later steps than the one that this process last wrote or
        verified. Raises OSError if a checkpoint cannot be read now.
        """
        found = []
        for step, path in self.checkpoints():
            if (self._intact is None or step <= self._intact) and (manifest := read_manifest(path)) is not None:
                found.append((path, self._located(manifest)))
        return found

    def give_up_checkpoint(self) -> bool:
        """Remove the earliest checkpoint whose Gaussians are in a scratch file, to free slots there.

        Returns False if only the latest intact checkpoint is left, which stays. Raises OSError.
        """
        found = self.manifests()
        if self._intact is None or len(found) < 2:
            return False
        remove(found[0][0])
        return True

    def _located(self, manifest: Manifest) -> Manifest:
        """Return the manifest with its scratch file's path: in `scratch_path` if the file is there, else unchanged."""
        here = self.scratch_path.absolute() / manifest.path.name
        return replace(manifest, path=here) if here.is_file() else manifest

    def _verified(self, checkpoint: Checkpoint) -> Checkpoint:
        """Return the checkpoint after verifying the chunks in its scratch file. Raises ValueError or ScratchError."""
        if checkpoint.manifest is None:
            return checkpoint
        if SCRATCH_NAME.fullmatch(checkpoint.manifest.path.name) is None:
            raise ValueError(f"its manifest names {checkpoint.manifest.path}, expected a file *{SCRATCH_SUFFIX}")
        manifest = self._located(checkpoint.manifest)
        with closing(ChunkStore.opened(manifest, writable=False)) as store:
            store.verify()
        return replace(checkpoint, manifest=manifest)

    def load_latest_checkpoint(self) -> Checkpoint | None:
        """Return the latest intact checkpoint; None if there are no checkpoints.

        A damaged checkpoint is skipped with a warning. In a run that is resumed, metrics.jsonl is truncated to the
        checkpoint's step, and temporary files of a killed process are removed. Raises InputError if there are
        checkpoints but none is intact.
        """
        checkpoints = self.checkpoints()
        checkpoint: Checkpoint | None = None
        why = ""
        for step, path in reversed(checkpoints):
            try:
                checkpoint = self._verified(read_checkpoint(path, step))
                self._intact = step
                break
            except Exception as error:  # noqa: BLE001  # zipfile and NumPy raise nearly any exception for a flipped bit
                why = str(error) or type(error).__name__
                warn(f"{path}: is a damaged checkpoint and is skipped ({why})")
        if checkpoints and checkpoint is None:
            raise InputError(
                f"{self.checkpoints_path}: has no intact checkpoint ({why}), use --overwrite to start again"
            )
        if checkpoint is None and (lost := max((record.get("step", 0) for record in self.read_metrics()), default=0)):
            warn(f"{self.path}: has no checkpoint: training starts again, and the {lost} earlier steps are lost")
        if self.resuming:
            for left in self.path.rglob(".*" + TEMPORARY_SUFFIX):
                remove(left)
            self.truncate_metrics(checkpoint.step if checkpoint else 0)
        return checkpoint


def model_file(path: Path) -> Path:
    """Return the path of the model file of a run's folder or a model's folder, or `path` if it is a file.

    Raises InputError for a run without a model.
    """
    if not path.is_dir():
        return path
    if not is_run(path) and (model := model_path(path)) != path:
        return model
    trained = Run.open(path)
    if not trained.model_path.exists():
        raise InputError(f"{trained.model_path}: no such file, the run has not written its model yet")
    return trained.model_path


def is_run(path: Path) -> bool:
    """True if the folder holds a config.toml that clsplat wrote."""
    return is_settings_of_run(path / "config.toml")


def run_of(model: Path) -> Run | None:
    """Return the run that a model belongs to: the folder `model`, or the folder that contains it. None if neither is
    a run."""
    return next((Run.open(path) for path in (model, model.parent) if is_run(path)), None)


def check_output(path: Path, *, resume: bool, overwrite: bool, beside: Collection[str] = ()) -> None:
    """Raise InputError if a run cannot be created at `path`.

    resume: True to check instead if the run at `path` can be resumed.
    overwrite: True to allow an existing run, whose files are then replaced.
    beside: names of other files and folders that may be at `path`.
    """
    if resume and overwrite:
        raise InputError("--resume and --overwrite exclude each other")
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file, expected a folder for the run")
    if resume and not is_run(path):
        raise InputError(f"{path}: has no run to resume (no config.toml of clsplat)")
    if is_run(path):
        if not (resume or overwrite):
            raise InputError(f"{path}: is already a run, use --resume to go on with it or --overwrite to replace it")
    elif path.is_dir():
        names = (entry.name for entry in path.iterdir() if entry.name not in beside)
        foreign = sorted(name for name in names if not name.startswith("."))
        if foreign:
            raise InputError(f"{path}: is not a run but has files ({foreign[0]}), expected an empty or new folder")


def owned_files(path: Path) -> list[Path]:
    """Files in a run's folder that clsplat wrote, which --overwrite may therefore remove."""
    patterns = (
        "checkpoints/step-*.npz",
        "trouble-step-*.npz",
        "test/**/*.png",
        "depth/**/*.png",
        "refined/*.txt",
        f"refined/{GEOREFERENCE_FILE}",
        "cache/*.pixels",
        f"scratch/*{SCRATCH_SUFFIX}",
        "**/.*" + TEMPORARY_SUFFIX,
    )
    # config.toml last: an interrupted removal still leaves a run, which --overwrite can remove.
    learnt = (APPEARANCE_FILE, "appearance.npz")
    records = ("eval.json", *learnt, "report.html", FRAME_RECORD_FILE, GEOREFERENCE_FILE, "scene.json")
    names = ("model.ply", "metrics.jsonl", *records, "config.toml")
    files = [file for pattern in patterns for file in sorted(path.glob(pattern))] + [path / name for name in names]
    return [file for file in files if file.is_file() or file.is_symlink()]


def check_resumed(earlier: Run, config: TrainConfig) -> None:
    """Raise InputError if `config` changes a setting that a resumed run has to keep."""
    of_model = ("sh_degree", "seed", "test_every", "test_most", "lenses", "appearance", "antialiased", "perspective")
    for name in (*of_model, "orient", "scale", "refine_poses", "refine_lenses"):
        was, now = getattr(earlier.config, name), getattr(config, name)
        if was != now:
            raise InputError(f"{earlier.config_path}: {name} is {was}, a resumed run cannot change it to {now}")
