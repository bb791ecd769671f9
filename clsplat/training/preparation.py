# SPDX-License-Identifier: Apache-2.0
"""Preparation of a training before its first step: checks, length unit, start points, depths, settings, and
the Gaussians of a checkpoint."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from clsplat.chunks.store import ChunkStore
from clsplat.config.points import SCENE_POINTS_ONLY
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError
from clsplat.images.alpha import background_colour
from clsplat.runs import scene_record
from clsplat.runs.checkpoints import Checkpoint, unusable
from clsplat.runs.run import Run, check_resumed
from clsplat.scenes.analysis import sanity_checks
from clsplat.scenes.depth_sources import length_unit_of, with_depths
from clsplat.scenes.scene import Scene, View
from clsplat.scenes.start.point_cloud import is_colourless, photographed, with_points
from clsplat.stages.device_gaussians import KINDS, HostGaussians, SavedArray, host_model, saved_models
from clsplat.training.cameras.refinement import check_refinable
from clsplat.training.start import NO_START, Start


def prepared(scene: Scene, config: TrainConfig, resumed: Run | None = None, start: Start = NO_START) -> Scene:
    """Scene with its length unit, start points and known depths; `scene` itself if it has them already.

    resumed: the run that continues, which keeps its length unit.
    start: initial model, region and appearance. With a model, it needs no points beyond the scene's.
    Raises InputError if training with its points, depths or refined cameras would fail.
    """
    scene.require_training_views()
    check_refinable(config, scene.train_views)
    points = config.start_points if start.model is None else SCENE_POINTS_ONLY
    is_prepared = bool(points) and scene.start == points
    if not len(scene.points) and not points.sky:  # the length unit is computed from these points
        scene = with_points(scene, points)
    unit = _length_unit(scene, resumed, is_prepared=is_prepared)
    if unit != scene.unit:
        scene = replace(scene, unit=unit)
    scene = with_points(scene, points)
    return with_depths(scene, config.depth_use)


def _length_unit(scene: Scene, resumed: Run | None, *, is_prepared: bool) -> float | None:
    """Length unit in world units; None if it is the extent, which in some scenes depends on the start points.

    resumed: the run that continues, or None. It keeps its unit, which is the extent if scene.json is missing.
    is_prepared: True if the scene already has its unit. Its points may then be unfit to compute a unit from, such as
        points of a sky.
    """
    record = None if resumed is None else scene_record.read(resumed)
    if record is not None:
        return scene_record.length_unit_of(record)
    began = resumed is not None and bool(resumed.checkpoints())
    if scene.unit is not None or is_prepared:
        return None if began else scene.unit
    unit = length_unit_of(scene)
    if unit == scene.extent:
        return None
    if resumed is None or not began:
        return unit
    warnings.warn(
        f"{resumed.path / scene_record.SCENE_RECORD_FILE_NAME}: is missing, so lengths are relative to the extent "
        f"{scene.extent:.4g}; if they were relative to {unit:.4g} when the training began, start a new training"
    )
    return None


def is_along_rays(config: TrainConfig, views: Sequence[View]) -> bool:
    """True if a model is trained along the rays of pixels: if the settings ask for it, or if some view needs it."""
    asked = config.perspective
    return asked == "rays" or (asked == "auto" and any(view.camera.model.along_rays for view in views))


def check_steps_left(run: Run, config: TrainConfig, name: str) -> None:
    """Raise InputError if a run has a checkpoint after the last step of `config`.

    name: name of the setting that the message asks to change, such as "--iterations".
    """
    if (done := max((step for step, _ in run.checkpoints()), default=0)) > config.iterations:
        raise InputError(f"{name} {config.iterations}: {run.path} is already at step {done}; expected more steps")


def begin(scene: Scene, config: TrainConfig, run: Run | None, *, resume: bool, start: Start = NO_START) -> Scene:
    """Prepare the scene, and record it and the settings in the run if there is one. Returns the scene to train on.

    Unless training continues from a checkpoint, also warn of faults that `sanity_checks.of_scene` finds, and give
    points without colours the photographs' colours.
    start: initial model, region and appearance.

    Raises InputError without `resume` if the run has been trained already, and with `resume` if its scene was another.
    """
    scene = prepared(scene, config, run if resume else None, start)
    if run is not None:
        if not resume and (run.checkpoints() or run.read_metrics()):
            raise InputError(
                f"{run.path}: has been trained already; resume=True continues it, Run.create(..., overwrite=True) "
                "starts anew"
            )
        run.keep_config(config)
        if resume:
            scene_record.check(run, scene, run.scene or Path(scene.name), config.resolution)
        scene_record.keep(run, scene, resuming=resume)
        if resume and run.checkpoints():
            return scene
    for text in sanity_checks.of_scene(scene, config.background):
        warnings.warn(text)
    if start.model is None and is_colourless(scene):
        warnings.warn(f"{scene.name}: the points have no colours, and get their colours from the photographs")
        scene = replace(scene, point_colors=photographed(scene, background_colour(config.background)))
    return scene


def check_scene(scene: Scene) -> None:
    """Raise InputError for anything but a scene with training views."""
    if not isinstance(scene, Scene):
        raise InputError(f"scene is {scene!r:.100}, expected clsplat.load_scene(...)")
    scene.require_training_views()


def settings_of(config: TrainConfig | None, run: Run | None, *, resume: bool) -> TrainConfig:
    """Settings of the training. Raises InputError for invalid arguments of `clsplat.train`."""
    if not isinstance(config, TrainConfig | None):
        raise InputError(f"config is {config!r:.100}, expected TrainConfig(...)")
    if not isinstance(run, Run | None):
        raise InputError(f"run is {run!r:.100}, expected Run.create(...)")
    if resume and run is None:
        raise InputError("resume=True: expected run=..., the run to continue")
    if config is None:
        config = run.config if run is not None else TrainConfig()
    config.check()
    if resume and run is not None:
        check_resumed(run, config)
        check_steps_left(run, config, "iterations")
    return config


def late_settings(config: TrainConfig) -> Iterator[str]:
    """Yield a warning for each non-default setting that takes effect after the last step, or before the first."""
    last, expected = config.iterations, f"expected at most --iterations {config.iterations}"
    ends = f"training ends at step {last}"
    density = config.density
    if density.every and density.fills and density.stop > last:
        yield (
            f"--density.growth {density.growth}: --density.max-gaussians {density.max_gaussians:,} is reached at "
            f"--density.stop {density.stop}, but {ends}; expected a --density.stop of at most --iterations "
            f"{last}, such as {5 * last // 7}"
        )
    optimiser = config.optimiser
    if optimiser.cooldown > last:
        part = optimiser.cooldown_to ** (1 - last / optimiser.cooldown)
        yield (
            f"--optimiser.cooldown {optimiser.cooldown}: the learning rates begin at {part:.2g} of their values, as "
            f"training has only {last} steps; {expected}"
        )
    late = [step for step in config.warmup if step >= max(last, 2)]
    if late and tuple(config.warmup) != TrainConfig.warmup:
        yield (
            f"--warmup {','.join(map(str, late))}: the training resolution does not double after these steps, because "
            f"{ends} at 1/{2 ** len(late)} of the size; expected steps below --iterations {last}"
        )


@contextmanager
def saved_model(checkpoint: Checkpoint, sh_degree: int) -> Iterator[tuple[list[HostGaussians], Checkpoint]]:
    """Context that yields parameters, first and second moments of a checkpoint, and the checkpoint with all its arrays.

    sh_degree: final SH degree of the training.
    If some arrays are in a scratch file, the file is open within the context. Raises InputError for arrays of another
    model.
    """
    saved: Mapping[str, Any] = {}
    with ExitStack() as reading:
        try:
            if checkpoint.manifest is not None:
                store = reading.enter_context(closing(ChunkStore.opened(checkpoint.manifest, writable=False)))
                models = saved_models(store)
                saved = {name: SavedArray(store, name) for name in store.fields}
            else:
                models = [host_model(checkpoint.arrays, kind) for kind in KINDS]
            n, most = max(model.coefficients for model in models), (sh_degree + 1) ** 2
            if n > most:
                raise ValueError(f"has {n} SH coefficients, more than the {most} of --sh-degree {sh_degree}")
        except ValueError as error:
            raise unusable(checkpoint, str(error)) from None
        yield models, replace(checkpoint, arrays={**checkpoint.arrays, **saved})
