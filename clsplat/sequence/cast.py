# SPDX-License-Identifier: Apache-2.0
"""The models of a job: one file, those of a shot, or those that a USD stage places. Without a device."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from clsplat.errors import InputError
from clsplat.files import digest
from clsplat.gaussians import Gaussians
from clsplat.models.formats import colour_space, format_of
from clsplat.models.placed import Ensemble, Placement, State, Track, gone_on, near_of
from clsplat.runs.run import model_file
from clsplat.sequence.task import RenderOptions, Task, end_before, model_times
from clsplat.shots.layout import KeyedTrack, Volume, Within, is_layout, read_layout
from clsplat.shots.read import USD
from clsplat.shots.stage import read_stage


@dataclass(frozen=True, eq=False)
class Cast:
    """The models of a job.

    path: of the file that says so; models: in their own worlds; names: of each; digest: SHA-256 of what they are read
    from, of a model file alone that of the file; space: the colour space of all; tracks: their placements, None for a
    model that is taken as it is; files: of the models, none of a stage; volumes: of each model, those that have mattes.
    """

    path: Path
    models: tuple[Gaussians, ...]
    names: tuple[str, ...]
    digest: str
    space: str
    tracks: tuple[Track, ...] | None = None
    files: tuple[Path, ...] = ()
    volumes: tuple[tuple[Volume, ...], ...] = ()

    @property
    def drawn(self) -> Gaussians | tuple[Gaussians, ...]:
        """The models as a `FrameRenderer` takes them."""
        return self.models[0] if self.tracks is None else self.models

    def state(self, frame: float) -> State | None:
        """Placements at a frame, None where there are none. Raises InputError for one that cannot be."""
        return None if self.tracks is None else tuple(track.at(frame) for track in self.tracks)

    def at(self, frame: float) -> Gaussians:
        """All models at a frame, as one."""
        state = self.state(frame)
        return self.models[0] if state is None else Ensemble(self.models).at(state)

    def seen(self, tasks: Sequence[Task], options: RenderOptions) -> list[Task]:
        """The tasks with the placements of their models, and cameras as these want them. Raises InputError."""
        known: dict[Placement | State, Placement | State] = {}  # what is the same is held once
        placed = []
        for task in tasks:
            views = [self._seen(view, options, known) for view in task.views]
            placed.append(replace(views[0], right=views[1] if views[1:] else None))
        return placed

    def _seen(self, task: Task, options: RenderOptions, known: dict[Placement | State, Placement | State]) -> Task:
        """A view with its placements."""
        model, times = self.models[0], model_times(task, options)
        if self.tracks is None:
            return task.seen_by(model, dict.fromkeys(times, model.near))
        states: dict[float, State] = {}
        for time in times:
            end, frame = end_before(task, time, options), task.number + time
            if end is None:
                state = [track.at(frame) for track in self.tracks]
            else:
                state = [gone_on(track, frame, task.number + end) for track in self.tracks]
            kept = tuple(known.setdefault(placement, placement) for placement in state)
            states[time] = known.setdefault(kept, kept)  # type: ignore[arg-type, assignment]
        nears = {time: near_of(self.models, state) for time, state in states.items()}
        seen = task.seen_by(replace(model, near=nears[times[0]]), nears)
        return replace(seen, placed=states)


def load_cast(path: Path, transform: KeyedTrack | None = None) -> Cast:
    """The models that MODEL means, a run, a model file, a shot of several models or a USD stage; transform: of all.

    Raises InputError for what cannot be read, and for models of several colour spaces or ways of drawing.
    """
    if is_layout(path):
        cast = _of_layout(path)
    else:
        file = model_file(path)
        stage = read_stage(file) if file.suffix.lower() in USD and format_of(file).name == "OpenUSD" else None
        if stage is not None:
            cast = Cast(file, stage.models, stage.names, stage.digest, stage.space, stage.tracks)
        else:
            cast = Cast(file, (Gaussians.load(file),), (file.stem,), digest(file), colour_space(file), None, (file,))
    if transform is None:
        return cast
    inner = cast.tracks or (KeyedTrack(str(path)),)
    return replace(cast, tracks=tuple(Within(track, transform) for track in inner))


def _of_layout(path: Path) -> Cast:
    """The models of a shot; those of one file are read once."""
    entries = read_layout(path)
    files: dict[Path, tuple[Gaussians, str, str]] = {}
    sums = hashlib.sha256()
    for entry in entries:
        where = f"{path}: model '{entry.name}'"
        try:
            if is_layout(entry.path):
                raise InputError(f"{entry.path}: is no model file, expected one")
            file = model_file(entry.path)
            if file not in files:
                files[file] = Gaussians.load(file), digest(file), colour_space(file)
        except InputError as error:
            raise InputError(f"{where}: {error}") from None
        sums.update(files[file][1].encode())
    found = [files[model_file(entry.path)] for entry in entries]
    first, _, space = found[0]
    for entry, (model, _, own) in zip(entries, found, strict=True):
        where = f"{path}: model '{entry.name}'"
        if own != space:
            raise InputError(f"{where}: is of the colour space {own}, expected {space} as '{entries[0].name}' is")
        if model.antialiased != first.antialiased:
            raise InputError(f"{where}: is {_not(model.antialiased)}antialiased, '{entries[0].name}' is otherwise")
        if model.by_rays != first.by_rays:
            raise InputError(f"{where}: is {_not(model.by_rays)}drawn along rays, '{entries[0].name}' is otherwise")
    names, tracks = tuple(entry.name for entry in entries), tuple(entry.track for entry in entries)
    models, volumes = tuple(model for model, _, _ in found), tuple(entry.volumes for entry in entries)
    paths = tuple(model_file(entry.path) for entry in entries)
    return Cast(path, models, names, sums.hexdigest(), space, tracks, paths, volumes)


def _not(is_so: bool) -> str:
    return "" if is_so else "not "
