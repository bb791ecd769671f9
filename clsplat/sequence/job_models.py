# SPDX-License-Identifier: Apache-2.0
"""Models of a render job: one model file, one file per frame, the models of a shot file, or those of a USD stage. Needs
no device."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.config.channels import CRYPTOMATTE_CHANNELS
from clsplat.config.pictures import PictureConfig
from clsplat.errors import InputError, warn
from clsplat.files.documents import digest
from clsplat.frame.mattes import Matte
from clsplat.gaussians import Gaussians
from clsplat.models.formats import colour_space, format_of, unpacked
from clsplat.models.formats.ply import read_whole_numbers
from clsplat.models.formats.usd import USD_SUFFIXES
from clsplat.models.instances import Changing, Ensemble, Placement, State, Track, extrapolated, kind_of, near_of
from clsplat.models.series import ModelSeries
from clsplat.runs.run import model_file
from clsplat.sequence.numbered import digest_of_name, is_sequence, open_sequence
from clsplat.sequence.task import MatteNames, Task, end_before, model_times
from clsplat.shots.frame_numbers import ranges
from clsplat.shots.shot_file import KeyedTrack, Volume, Within, is_layout, read_layout
from clsplat.shots.usd_models import read_stage

Known = dict[Placement | State, Placement | State]
"""Cache that maps each placement to itself, so that equal placements are stored once."""
MAX_MATTE_OBJECTS = 256
"""Maximum number of objects in a Cryptomatte. Each object takes a float per pixel while a frame is rendered."""


@dataclass(frozen=True, eq=False)
class JobModels:
    """The models of a job, and their placements over time.

    path: the model file, shot file, USD stage or pattern of files that defines the models.
    models: the models, each in its own world.
    names: name of each model, for Cryptomattes.
    digest: SHA-256 of the model file, or of the digests of several files.
    space: the colour space of all models.
    tracks: placements of the models over time; None for a single model that is not placed.
    files: files of the models; empty for a USD stage.
    volumes: for each model, regions of it that are separate Cryptomatte objects.
    numbered: for each model, its files by frame number; empty for a model that does not change.
    """

    path: Path
    models: tuple[Gaussians | ModelSeries, ...]
    names: tuple[str, ...]
    digest: str
    space: str
    tracks: tuple[Track, ...] | None = None
    files: tuple[Path, ...] = ()
    volumes: tuple[tuple[Volume, ...], ...] = ()
    numbered: tuple[dict[int, Path], ...] = ()

    @property
    def drawn(self) -> Gaussians | tuple[Gaussians | ModelSeries, ...]:
        """The models as `FrameRenderer` takes them: a single model that is not placed, or a tuple of models."""
        return self.one if self.tracks is None else self.models

    @property
    def one(self) -> Gaussians:
        """The model of a job with a single model that is not placed."""
        return self.still[0]

    @property
    def still(self) -> tuple[Gaussians, ...]:
        """The models that do not change over time: all except `ModelSeries`."""
        return tuple(model for model in self.models if not isinstance(model, ModelSeries))

    @property
    def count(self) -> int:
        """Number of Gaussians in all models. For a model that changes over time, only its first file counts."""
        return sum(model.count if isinstance(model, ModelSeries) else len(model) for model in self.models)

    @property
    def changing(self) -> bool:
        """True if a model changes over time."""
        return any(isinstance(model, ModelSeries) for model in self.models)

    @property
    def frames(self) -> tuple[int, ...]:
        """Frame numbers, in increasing order, for which changing models have files."""
        return tuple(sorted({number for files in self.numbered for number in files}))

    def state(self, frame: float) -> State | None:
        """Return the placements of the models at a frame; None if they are not placed.

        Raises InputError for an invalid placement.
        """
        return None if self.tracks is None else tuple(track.at(frame) for track in self.tracks)

    def at(self, frame: float) -> Gaussians:
        """Merge all models into one, as they are at a frame."""
        state = self.state(frame)
        return self.one if state is None else Ensemble(self.models).at(state)

    def mattes(self, channels: Collection[str], ids_from: str = "") -> dict[str, Matte]:
        """Make the Cryptomattes that are among the channels. Returns them by channel. Raises InputError.

        ids_from: property of the model files that holds semantic ids.
        """
        made = {}
        if self.changing and (asked := [name for name in CRYPTOMATTE_CHANNELS if name in channels]):
            raise InputError(
                f"--channels {asked[0]}: {self.path} changes over time, expected models whose Gaussians do not change"
            )
        if "objects" in channels:
            made["objects"] = self._objects()
        if "semantic" in channels:
            made["semantic"] = self._semantic(ids_from)
        for name, matte in made.items():
            if len(matte.names) > MAX_MATTE_OBJECTS:
                raise InputError(
                    f"--channels {name}: has {len(matte.names):,} objects, expected at most {MAX_MATTE_OBJECTS}"
                )
        return made

    def _objects(self) -> Matte:
        """Make a Cryptomatte with one object for each model, and one for each volume of a model.

        A Gaussian in a volume belongs to the volume's object, not to the model's. If several volumes contain it, the
        first of them counts.
        """
        names, owners = list(self.names), []
        for index, model in enumerate(self.still):
            own = np.full(len(model), index, np.int32)
            # reversed: of several volumes that contain a Gaussian, the first is assigned last, and stays
            for volume in reversed(self.volumes[index] if self.volumes else ()):
                own[volume.holds(model)] = len(names)
                names.append(volume.name)
            owners.append(own)
        return Matte(tuple(names), np.concatenate(owners))

    def _semantic(self, ids_from: str) -> Matte:
        """Make a Cryptomatte with one object for each value of the property `ids_from` of the model files."""
        if not self.files:
            raise InputError(f"--ids-from {ids_from}: {self.path} is a USD stage, expected PLY files with the property")
        columns: list[NDArray[np.int64]] = []
        for file, model in zip(self.files, self.still, strict=True):
            with unpacked(file) as (opened, form):
                if form.name != "3DGS PLY":
                    found = f"{file} is {form.name}, expected a 3DGS PLY that has the property"
                    raise InputError(f"--ids-from {ids_from}: {found}")
                columns.append(read_whole_numbers(opened, ids_from))
            assert len(columns[-1]) == len(model)
        numbers, owners = np.unique(np.concatenate(columns), return_inverse=True)
        return Matte(tuple(str(number) for number in numbers.tolist()), owners.astype(np.int32))

    def seen(self, tasks: Sequence[Task], pictures: PictureConfig, channels: Collection[str]) -> list[Task]:
        """Return the tasks with the models' placements, near planes and kind of projection.

        Raises InputError for frames without a file and for invalid placements.
        """
        known: Known = {}
        self._check_numbers([task.number for task in tasks])
        placed = []
        for task in tasks:
            views = [self._seen(view, pictures, model_times(view, pictures, channels), known) for view in task.views]
            placed.append(replace(views[0], right=views[1] if views[1:] else None))
        return placed

    def _seen(self, task: Task, pictures: PictureConfig, times: Sequence[float], known: Known) -> Task:
        """Return the task of one view, with the placements of the models at `times`.

        times: in frames relative to the task's frame, the shutter's middle first.
        known: cache of placements.
        """
        model = kind_of(self.models[0])
        if self.tracks is None:
            return task.seen_by(model, dict.fromkeys(times, model.near))
        states: dict[float, State] = {}
        for time in times:
            end, frame = end_before(task, time, pictures), task.number + time
            if end is None:
                state = [track.at(frame) for track in self.tracks]
            else:
                state = [extrapolated(track, frame, task.number + end) for track in self.tracks]
            kept = tuple(known.setdefault(placement, placement) for placement in state)
            states[time] = known.setdefault(kept, kept)  # type: ignore[arg-type, assignment]
        nears = {time: near_of(self.models, state) for time, state in states.items()}
        seen = task.seen_by(replace(model, near=nears[times[0]]), nears)
        return replace(seen, placed=states, files=self._files_of(states.values()))

    def _files_of(self, states: Iterable[State]) -> tuple[Path, ...]:
        """Return the files of changing models for these placements, and tell the models which files will be needed."""
        found: dict[Path, None] = {}
        for state in states:
            for index, placement in enumerate(state):
                if isinstance(series := self.models[index], ModelSeries) and placement.frame is not None:
                    series.expect([placement.frame])
                    paths = list(self.numbered[index].values()) if self.numbered else []
                    found.update(dict.fromkeys(paths[sample] for sample in series.sources(placement.frame) if paths))
        return tuple(found)

    def _check_numbers(self, numbers: Sequence[int]) -> None:
        """Raise InputError for frames before the first or after the last file of a sequence. Warns of missing files."""
        for path, files in zip(self.files, self.numbered, strict=False):
            if not files:
                continue
            first, last, have = min(files), max(files), f"there are files for {ranges(list(files))}"
            if beyond := [number for number in numbers if not first <= number <= last]:
                raise InputError(
                    f"{path}: has no file for frame(s) {ranges(sorted(set(beyond)))}; {have}; give --frames "
                    f"{first}-{last}, or cameras of these frames"
                )
            if missing := sorted({number for number in numbers if number not in files}):
                warn(f"{path}: has no file for frame(s) {ranges(missing)}, so neighbouring files are used; {have}")


def names_of(mattes: Mapping[str, Matte]) -> tuple[MatteNames, ...]:
    """Return channel, object names and a digest of each Cryptomatte, for the options of a job."""
    return tuple(
        MatteNames(name, mattes[name].names, hashlib.sha256(mattes[name].owners.tobytes()).hexdigest()[:32])
        for name in CRYPTOMATTE_CHANNELS
        if name in mattes
    )


def load_job_models(path: Path, transform: KeyedTrack | None = None) -> JobModels:
    """Load the models at a path: a run folder, a model file, a pattern of files by frame, a shot file or a USD stage.

    transform: a transform over time that is applied to all models; None leaves them in place.
    Raises InputError for an unreadable file, and for models that differ in colour space or rendering method.
    """
    if is_layout(path):
        job_models = _of_layout(path)
    elif is_sequence(path):
        series, files = open_sequence(path)
        space, track = colour_space(next(iter(files.values()))), Changing(KeyedTrack(str(path)))
        digested = digest_of_name(path)
        job_models = JobModels(path, (series,), (path.stem,), digested, space, (track,), (path,), numbered=(files,))
    else:
        file = model_file(path)
        stage = read_stage(file) if file.suffix.lower() in USD_SUFFIXES and format_of(file).name == "OpenUSD" else None
        if stage is not None:
            job_models = JobModels(file, stage.models, stage.names, stage.digest, stage.space, stage.tracks)
        else:
            job_models = JobModels(
                file, (Gaussians.load(file),), (file.stem,), digest(file), colour_space(file), None, (file,)
            )
    if transform is None:
        return job_models
    inner = job_models.tracks or (KeyedTrack(str(path)),)
    return replace(job_models, tracks=tuple(Within(track, transform) for track in inner))


@dataclass(frozen=True)
class _Opened:
    """A loaded model of a shot file.

    digest: SHA-256 of the file; for one file per frame, of the pattern's text.
    space: colour space of the model.
    file: file of the model; for one file per frame, the pattern of the files.
    numbered: files by frame number; empty for a model that does not change.
    """

    model: Gaussians | ModelSeries
    digest: str
    space: str
    file: Path
    numbered: dict[int, Path]


def _opened(path: Path) -> _Opened:
    if is_sequence(path):
        series, files = open_sequence(path)
        return _Opened(series, digest_of_name(path), colour_space(next(iter(files.values()))), path, files)
    if is_layout(path):
        raise InputError(f"{path}: is a shot file, expected a model file")
    file = model_file(path)
    return _Opened(Gaussians.load(file), digest(file), colour_space(file), file, {})


def _of_layout(path: Path) -> JobModels:
    """Load the models of a shot file. A model file that several of them share is read once."""
    entries = read_layout(path)
    known: dict[Path, _Opened] = {}
    sums = hashlib.sha256()
    found = []
    for entry in entries:
        where = f"{path}: model '{entry.name}'"
        try:
            if entry.path not in known:
                known[entry.path] = _opened(entry.path)
        except InputError as error:
            raise InputError(f"{where}: {error}") from None
        found.append(known[entry.path])
        sums.update(found[-1].digest.encode())
    space, first = found[0].space, kind_of(found[0].model)
    for entry, opened in zip(entries, found, strict=True):
        where, kind = f"{path}: model '{entry.name}'", kind_of(opened.model)
        if opened.space != space:
            raise InputError(
                f"{where}: has the colour space {opened.space}, expected {space} like model '{entries[0].name}'"
            )
        if kind.antialiased != first.antialiased:
            raise InputError(f"{where}: is {_not(kind.antialiased)}antialiased, unlike model '{entries[0].name}'")
        if kind.by_rays != first.by_rays:
            raise InputError(f"{where}: is {_not(kind.by_rays)}rendered along rays, unlike model '{entries[0].name}'")
        if entry.volumes and isinstance(opened.model, ModelSeries):
            raise InputError(f"{where}: has 'mattes' and changes over time, expected one model for all frames")
    tracks = tuple(
        Changing(entry.track) if isinstance(opened.model, ModelSeries) else entry.track
        for entry, opened in zip(entries, found, strict=True)
    )
    return JobModels(
        path,
        tuple(opened.model for opened in found),
        tuple(entry.name for entry in entries),
        sums.hexdigest(),
        space,
        tracks,
        tuple(opened.file for opened in found),
        tuple(entry.volumes for entry in entries),
        tuple(opened.numbered for opened in found),
    )


def _not(is_so: bool) -> str:
    return "" if is_so else "not "
