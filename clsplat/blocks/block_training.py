# SPDX-License-Identifier: Apache-2.0
"""The trainings of a city after its plan: of each block, and the finish over all photographs on the merged model.

Each is an ordinary training in a run's folder. A call goes on where an earlier one stopped, and does nothing if the
training has finished.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from clsplat.blocks.block_scene import scene_of_block, scene_of_finish
from clsplat.blocks.block_settings import block_settings, finish_settings
from clsplat.blocks.merging import digests_of_blocks, merge_digest, merged_of, region_of
from clsplat.blocks.plan import BLOCKS_FOLDER, COARSE_FOLDER, BlockPlan, read_plan
from clsplat.blocks.plan_check import check_plan
from clsplat.blocks.progress_records import CITY_FILES, MERGED_FILE, check_begun, is_done, keep_done
from clsplat.blocks.surroundings import first_model_of_block
from clsplat.config.orientation import FrameUse
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError
from clsplat.files.atomic import atomic_write
from clsplat.gaussians import Gaussians
from clsplat.runs.locks import locked
from clsplat.runs.run import Run, is_run
from clsplat.scenes.dataset import SceneFrame
from clsplat.scenes.scene import Scene
from clsplat.training.start import Start

LoadScene = Callable[[TrainConfig, Path, FrameUse | SceneFrame], Scene]
"""Function that loads the scene in a folder, by the settings of a training and in a frame."""
TrainRun = Callable[[Scene, Run, Start], object]
"""Function that trains a run, new or resumed, on a scene, from a start. It knows device and memory."""


def train_block(city: Path, name: str, load: LoadScene, train: TrainRun, devices: int = 1) -> bool:
    """Train a block of the plan. Returns False if it has finished before.

    name: name of the block, such as "0,1".
    devices: number of devices of this machine that train it.
    Raises InputError if the plan does not fit the scene or the coarse model, if a photograph of the block is missing,
    or if another process trains the block.
    """
    plan = read_plan(city)
    block = plan.block(name)
    folder = city / BLOCKS_FOLDER / block.name
    if is_done(folder, plan.digest):
        return False
    with _begun(folder, plan.digest, plan.coarse):
        if is_done(folder, plan.digest):  # another process may have finished it
            return False
        coarse = Run.open(city / COARSE_FOLDER)
        scene = load(plan.settings, plan.scene, coarse.frame_to_resume())
        check_plan(city, scene, photographs=block.photographs)
        part, region = scene_of_block(scene, block, coarse), region_of(plan, block.widened)
        model = first_model_of_block(coarse.model_path, region, part, plan.settings)
        surroundings = len(model) - block.gaussians
        config = block_settings(plan, block, coarse.config, surroundings).on_devices(devices, explicit=False)
        run = Run.create(folder, config, scene=plan.scene, resume=is_run(folder), beside=CITY_FILES)
        run.resume_command = shlex.join(["clsplat", "blocks", "train", str(city), "--block", name])
        train(part, run, Start(model, region, _with_appearance(coarse)))
        keep_done(folder, plan.digest, plan.coarse)
    return True


def finish(city: Path, steps: int | None, load: LoadScene, train: TrainRun, devices: int = 1) -> bool:
    """Train the merged model on all photographs, and evaluate it. Returns False if that has been done before.

    steps: number of steps; None for the number of the run that goes on, or else of the plan.
    devices: number of devices of this machine that train it.
    Raises InputError if the blocks are not merged, if the plan does not fit the scene or the coarse model, or if
    another process writes the city's run.
    """
    plan = read_plan(city)
    merged = _merged(city, plan)
    config = finish_settings(plan, _steps(city, plan, steps)).on_devices(devices, explicit=False)
    config.check()
    with _begun(city, plan.digest, merged):
        same_start = is_done(city, plan.digest, merged)
        if same_start and Run.open(city).config.iterations == config.iterations:
            return False
        coarse = Run.open(city / COARSE_FOLDER)
        scene = load(plan.settings, plan.scene, coarse.frame_to_resume())
        check_plan(city, scene)
        run = Run.create(city, config, scene=plan.scene, resume=is_run(city), beside=CITY_FILES)
        run.resume_command = shlex.join(["clsplat", "blocks", "finish", str(city)])
        start = Start(Gaussians.load(city / MERGED_FILE), None, _with_appearance(coarse), trains_appearance=True)
        train(scene_of_finish(scene, coarse), run, start)
        _copy_refined(coarse, run)
        keep_done(city, plan.digest, merged)
    return True


def _steps(city: Path, plan: BlockPlan, asked: int | None) -> int:
    """Number of steps of the finish."""
    if asked is None:
        return Run.open(city).config.iterations if is_run(city) else max(plan.finish_steps, 1)
    if asked < 1:
        raise InputError(f"--finish {asked}: expected at least 1 step")
    return asked


def _merged(city: Path, plan: BlockPlan) -> str:
    """Return the digest of the merge in merged.ply. Raises InputError unless it has the models of all blocks."""
    wanted, path = merge_digest(plan, digests_of_blocks(city, plan)), city / MERGED_FILE
    if (found := merged_of(path)) != wanted:
        what = "is missing" if not path.exists() else f"is a merge of other models ({str(found)[:12]})"
        raise InputError(f"{path}: {what}, expected the merge of all blocks; run clsplat blocks merge {city}")
    return wanted


def _begun(folder: Path, plan: str, start: str) -> ExitStack:
    """Context that holds the write lock of a run's folder, in which a training begins or goes on.

    plan, start: digests of the plan, and of the model that the training begins with. Raises InputError if an earlier
    training in the folder had others, or if another process holds the lock.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as held:
        held.enter_context(locked(folder, "blocks"))
        check_begun(folder, plan, start)
        return held.pop_all()


def _with_appearance(coarse: Run) -> Path | None:
    """Folder of the run whose appearance is used; None if the settings learn no appearance."""
    return coarse.path if coarse.config.appearance != "none" else None


def _copy_refined(coarse: Run, run: Run) -> None:
    """Copy the refined cameras of the coarse model, with which `run` was trained, so that its users find them."""
    if coarse.config.refines:
        run.refined_path.mkdir(exist_ok=True)
        for path in sorted(coarse.refined_path.glob("*.txt")):
            atomic_write(run.refined_path / path.name, path.read_bytes())
