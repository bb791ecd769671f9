# SPDX-License-Identifier: Apache-2.0
"""Check that a plan still fits its scene, its settings and its coarse model."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

from clsplat.blocks.plan import (
    BLOCKS_FOLDER,
    COARSE_FOLDER,
    PLAN_FILE,
    BlockPlan,
    Partition,
    Point,
    read_plan,
    write_plan,
)
from clsplat.blocks.planning.ground import ground_of
from clsplat.blocks.progress_records import CITY_FILES
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError, examples
from clsplat.files.documents import known_digest
from clsplat.runs import scene_record
from clsplat.runs.run import Run, check_output, is_run
from clsplat.runs.settings import table_of
from clsplat.scenes.scene import Scene
from clsplat.training.preparation import prepared

OF_NO_MODEL = frozenset({"checkpoint_every", "eval_at", "stages_every", "report"})
"""Settings that do not change the model. They may differ from the plan's."""
SAME_UP_RADIANS = 1e-4
"""Angle up to which two up directions count as equal, as machines round estimates differently."""


def check_plan(
    city: Path, scene: Scene, config: TrainConfig | None = None, photographs: Collection[str] | None = None
) -> BlockPlan:
    """Read the plan in a city's folder, and check that it was made for a scene and settings. Returns the plan.

    scene: the scene as it is now, at the size of the plan's settings.
    config: settings of the training of the whole scene; None to leave them out.
    photographs: names of the views to compare; None for all views.
    Raises InputError that lists the differences: of the scene, of the settings, or of the coarse model's file.
    """
    plan = read_plan(city)
    path = city / PLAN_FILE
    if config is not None and (changed := settings_differences(plan.settings, config)):
        raise InputError(
            f"{path}: was made with other settings: {examples(changed)}; expected the settings of the plan, or a new "
            "folder for a new plan"
        )
    coarse = Run.open(city / COARSE_FOLDER)
    if known_digest(coarse.model_path) != plan.coarse:
        raise InputError(
            f"{coarse.model_path}: is not the coarse model that {path} was made with, expected this model; remove the "
            f"plan and the folder {city / COARSE_FOLDER}, and run clsplat blocks plan again"
        )
    if missing := _missing_results(coarse):
        raise InputError(
            f"{missing[0]}: no such file, expected the result of the coarse model; remove {path}, and run clsplat "
            "blocks plan again, which makes the same plan"
        )
    if changed := scene_differences(coarse, scene, plan.settings, photographs):
        raise InputError(
            f"{path}: was made for another scene than {scene.source or plan.scene} is now: {'; '.join(changed)}; "
            "expected the same views and photographs, or a new folder for a new plan"
        )
    return plan


def check_new_plan(city: Path) -> None:
    """Raise InputError if a plan cannot be made in the folder `city`, because the folder is used for something else."""
    of_city = any((city / name).exists() for name in (PLAN_FILE, COARSE_FOLDER))
    if is_run(city) and not of_city:
        raise InputError(f"{city}: is a run, but not of blocks; expected a new folder, or one with a plan")
    check_output(city, resume=is_run(city), overwrite=False, beside=CITY_FILES)


def kept_plan(
    city: Path, source: Path, scene: Scene, config: TrainConfig, division: Partition, up: Point | None
) -> BlockPlan | None:
    """Return the plan in a city's folder if it was made for this scene with these options.

    source: path of the scene. If the scene was moved, its path in plan.json is replaced.
    division, up: the options of the division; None for an up direction that is estimated.
    Returns None if there is no plan, or one with another division by which no block has begun. Raises InputError like
    `check_plan`, and for another division if a block has begun.
    """
    if not (city / PLAN_FILE).exists():
        return None
    plan = check_plan(city, scene, config)
    now = ground_of(scene, up).up
    if max(abs(a - b) for a, b in zip(plan.up, now, strict=True)) < SAME_UP_RADIANS:
        now = plan.up
    changed = [
        f"{flag} is {was} in the plan and {given} now"
        for flag, was, given in (
            ("--blocks", plan.division.blocks, division.blocks),
            ("--block-mem", plan.division.memory, division.memory),
            ("--block-photographs", plan.division.photographs, division.photographs),
            ("--up", *(",".join(f"{value:.6g}" for value in way) for way in (plan.up, now))),
        )
        if was != given
    ]
    if not changed:
        if plan.scene.resolve() != source.resolve():
            plan = replace(plan, scene=source.absolute())  # the digest is without the path, so blocks go on
            write_plan(city, plan)
        return plan
    if (city / BLOCKS_FOLDER).exists():
        raise InputError(
            f"{city / PLAN_FILE}: was made with other options: {examples(changed)}; expected the same, as blocks have "
            f"been trained by the plan; move {city / BLOCKS_FOLDER} away, or give a new folder"
        )
    return None


def check_coarse(coarse: Run, wanted: TrainConfig, scene: Scene, config: TrainConfig) -> bool:
    """Check that the coarse model is trained on a scene with the wanted settings. Returns True if it is finished.

    It is finished once its run has the model, the learnt appearance and the refined cameras.

    wanted: settings for the training of the coarse model.
    scene, config: the scene at the size of the whole, and the settings of the whole.
    Raises InputError that lists the differences.
    """
    wanted = replace(wanted, batch=coarse.config.batch)  # the number of devices may have changed
    if changed := settings_differences(coarse.config, wanted, "for the coarse model"):
        raise InputError(
            f"{coarse.config_path}: has other settings: {examples(changed)}; expected the same, or a new folder for a "
            "new plan"
        )
    finished = not _missing_results(coarse) and coarse.model_record().get("step") == coarse.config.iterations
    if finished and (changed := scene_differences(coarse, scene, config)):
        raise InputError(
            f"{coarse.path}: was trained on another scene than {scene.source or scene.name} is now: "
            f"{'; '.join(changed)}; expected the same views and photographs, or a new folder for a new plan"
        )
    return finished


def _missing_results(coarse: Run) -> list[Path]:
    """Files that the blocks read of a run, and that are not there: a stopped training may have written only some."""
    wanted = coarse.result_files
    if coarse.config.refines:
        wanted += [coarse.refined_path / name for name in ("cameras.txt", "images.txt", "points3D.txt")]
    return [path for path in wanted if not path.exists()]


def settings_differences(planned: TrainConfig, now: TrainConfig, where: str = "in the plan") -> list[str]:
    """Return a text for each setting that shapes the model and differs, such as "seed is 0 in the plan and 1 now".

    where: place of the earlier settings, for the text.
    """
    was, given = _flat(table_of(planned)), _flat(table_of(now))
    return [
        f"{name.replace('_', '-')} is {was[name]} {where} and {given[name]} now"
        for name in was
        if was[name] != given[name] and name not in OF_NO_MODEL
    ]


def _flat(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the settings of nested tables by names such as "density.stop"."""
    flat: dict[str, Any] = {}
    for name, value in table.items():
        flat |= _flat(value, f"{name}.") if isinstance(value, dict) else {prefix + name: value}
    return flat


def scene_differences(
    coarse: Run, scene: Scene, settings: TrainConfig, photographs: Collection[str] | None = None
) -> list[str]:
    """Return short descriptions of the differences between the scene of the coarse model's run and a scene.

    settings: settings of the training of the whole scene.
    photographs: names of the views to compare; None for all views.
    The cameras are compared at the size of the coarse model's photographs.
    """
    earlier = scene_record.read(coarse)
    if earlier is None:
        return [f"{coarse.path} has no {scene_record.SCENE_RECORD_FILE_NAME}"]
    scene = prepared(scene, settings, coarse)
    names = {view.name for view in scene.views} | set(earlier["views"]) if photographs is None else set(photographs)
    sizes = {name: view["size"] for name, view in earlier["views"].items() if name in names}
    views = [
        replace(view, camera=view.camera.resized(*sizes[view.name])) if view.name in sizes else view
        for view in scene.views
        if view.name in names
    ]
    if not views:
        return [f"all {len(names):,} views are missing now ({examples(sorted(names))})"]
    now = scene_record.record_of(replace(scene, views=views), earlier["resolution"])
    # `origin` comes from all cameras, so it is not known from a part of the views
    earlier = {**earlier, "views": {name: view for name, view in earlier["views"].items() if name in names}}
    # The coarse model's photographs are smaller, so the sky has another number of points. Points without colours get
    # other colours.
    if settings.sky:
        now["points"] = earlier["points"]
    return scene_record.differences(earlier, now, moved=True)
