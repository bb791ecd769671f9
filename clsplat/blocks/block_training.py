# SPDX-License-Identifier: Apache-2.0
"""The trainings of a city after its plan: of each block, and the finish over all photographs on the merged model.

Each is an ordinary training in a run's folder. A call goes on where an earlier one stopped, and does nothing if the
training has finished.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

from clsplat.blocks.block_scene import scene_of_block, scene_of_finish
from clsplat.blocks.block_settings import block_settings, finish_settings
from clsplat.blocks.merging import is_merged, merge_digest, merged_of, records_of_blocks, region_of_block
from clsplat.blocks.plan import BLOCKS_FOLDER, COARSE_FOLDER, Block, BlockPlan, read_plan
from clsplat.blocks.plan_check import check_plan
from clsplat.blocks.progress_records import (
    BEGUN_FILE,
    CITY_FILES,
    DONE_FILE,
    MERGED_APPEARANCE_FOLDER,
    MERGED_FILE,
    check_begun,
    is_done,
    keep_done,
)
from clsplat.blocks.surroundings import first_model_of_block
from clsplat.config.orientation import FrameUse
from clsplat.config.training import TrainConfig
from clsplat.errors import ClsplatError, InputError
from clsplat.files.atomic import atomic_write, remove
from clsplat.gaussians import Gaussians
from clsplat.runs.appearance import check_appearance
from clsplat.runs.locks import locked
from clsplat.runs.run import Run, is_run, owned_files
from clsplat.scenes.dataset import SceneFrame
from clsplat.scenes.scene import Scene
from clsplat.training.preparation import check_steps_left
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
    if is_trained(city, plan, block):
        return False
    with _begun(folder, plan.digest, plan.coarse, lambda: f"move {folder} away to train the block anew"):
        if is_trained(city, plan, block):  # another process may have finished it
            return False
        coarse = Run.open(city / COARSE_FOLDER)
        scene = load(plan.settings, plan.scene, coarse.frame_to_resume())
        check_plan(city, scene, photographs=block.photographs)
        part, region = scene_of_block(scene, plan, block, coarse), region_of_block(plan, block, widened=True)
        model = first_model_of_block(coarse.model_path, region, part, plan.settings)
        surroundings = len(model) - block.gaussians
        config = block_settings(plan, block, coarse.config, surroundings).on_devices(devices, explicit=False)
        run = Run.create(folder, config, scene=plan.scene, resume=is_run(folder), beside=CITY_FILES)
        run.resume_command = shlex.join(["clsplat", "blocks", "train", str(city), "--block", name])
        train(part, run, Start(model, region, coarse.path if plan.settings.appearance != "none" else None))
        keep_done(run, plan.digest, plan.coarse)
    return True


def finish(city: Path, steps: int | None, load: LoadScene, train: TrainRun, devices: int = 1) -> bool:
    """Train the merged model on all photographs, and evaluate it. Returns False if that has been done before.

    steps: number of steps; None keeps the number of the existing run; without a run it takes the plan's.
    devices: number of devices of this machine that train it.
    Raises InputError if the blocks are not merged, if the plan does not fit the scene or the coarse model, or if
    another process writes the city's run.
    """
    plan = read_plan(city)
    merged = _merged(city, plan)
    config = finish_settings(plan, _steps(city, plan, steps)).on_devices(devices, explicit=False)
    config.check()
    with _begun(city, plan.digest, merged, lambda: _how_to_finish_anew(city)):
        if is_finished(city, plan, config.iterations):
            return False
        if is_run(city):  # before config.toml gets the new number of steps
            check_steps_left(Run.open(city), config, "--finish")
        coarse = Run.open(city / COARSE_FOLDER)
        scene = load(plan.settings, plan.scene, coarse.frame_to_resume())
        check_plan(city, scene)
        start = _start_of_finish(city, plan, [view.name for view in scene.train_views])
        remove(city / DONE_FILE)  # of fewer steps: if it stayed, an interrupted training would count as finished
        run = Run.create(city, config, scene=plan.scene, resume=is_run(city), beside=CITY_FILES)
        run.resume_command = shlex.join(["clsplat", "blocks", "finish", str(city)])
        train(scene_of_finish(scene, plan, coarse), run, start)
        _copy_refined(coarse, run)
        keep_done(run, plan.digest, merged)
    return True


def _start_of_finish(city: Path, plan: BlockPlan, photographs: Sequence[str]) -> Start:
    """Read the merged model and check the merged appearance. Raises InputError that says how to merge again."""
    folder, kind = city / MERGED_APPEARANCE_FOLDER, plan.settings.appearance
    try:
        model = Gaussians.load(city / MERGED_FILE)
        if kind != "none":
            check_appearance(folder, kind, photographs)
    except InputError as error:
        raise InputError(f"{error}; remove the file, and run clsplat blocks merge {city}") from None
    return Start(model, None, folder if kind != "none" else None)


def is_trained(city: Path, plan: BlockPlan, block: Block) -> bool:
    """True if the training of a block has finished. Raises InputError for a damaged record of it."""
    return is_done(city / BLOCKS_FOLDER / block.name, plan.digest)


def is_finished(city: Path, plan: BlockPlan, steps: int | None) -> bool:
    """True if the finish has been trained on the merged models of all blocks.

    steps: number of steps that the finish must have; None for any number.
    """
    with suppress(ClsplatError):
        merged = merge_digest(plan, records_of_blocks(city, plan))
        return is_done(city, plan.digest, merged) and steps in (None, Run.open(city).config.iterations)
    return False


def _steps(city: Path, plan: BlockPlan, asked: int | None) -> int:
    """Number of steps of the finish."""
    if asked is None:
        return Run.open(city).config.iterations if is_run(city) else max(plan.finish_steps, 1)
    if asked < 1:
        raise InputError(f"--finish {asked}: expected at least 1 step")
    return asked


def _merged(city: Path, plan: BlockPlan) -> str:
    """Return the digest of the merge. Raises InputError unless it has the models and the appearances of all blocks."""
    wanted, path = merge_digest(plan, records_of_blocks(city, plan)), city / MERGED_FILE
    if not is_merged(city, plan):
        what = f"{path}: is missing" if not path.exists() else f"{path}: is no merge of blocks"
        with suppress(InputError):
            if (found := merged_of(path)) == wanted:
                what = f"{city / MERGED_APPEARANCE_FOLDER}: lacks the merged appearance"
            elif found is not None:
                what = f"{path}: is a merge of other models ({found[:12]})"
        raise InputError(f"{what}, expected the merge of all blocks; run clsplat blocks merge {city}")
    return wanted


def _begun(folder: Path, plan: str, start: str, advice: Callable[[], str]) -> ExitStack:
    """Context that holds the write lock of a run's folder, in which a training begins or goes on.

    plan, start: digests of the plan, and of the model that the training begins with.
    advice: function that returns in words how to train anew, for the message.
    Raises InputError if an earlier training in the folder had another plan or model, or if another process holds the
    lock.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as held:
        held.enter_context(locked(folder, "blocks"))
        check_begun(folder, plan, start, advice)
        return held.pop_all()


def _how_to_finish_anew(city: Path) -> str:
    """Return in words which files and folders of a city to remove, so that the finish begins anew."""
    parts = {file.relative_to(city).parts[0] for file in owned_files(city)}
    names = [BEGUN_FILE, DONE_FILE, *sorted(name for name in parts - CITY_FILES if not name.startswith("."))]
    there = ", ".join(name for name in names if (city / name).exists())
    return f"to train the finish anew, remove from this folder: {there}"


def _copy_refined(coarse: Run, run: Run) -> None:
    """Copy the refined cameras of the coarse model, with which `run` was trained, so that its users find them."""
    if coarse.config.refines:
        run.refined_path.mkdir(exist_ok=True)
        for path in sorted(coarse.refined_path.iterdir()):  # the cameras, and their place on the earth if it is known
            atomic_write(run.refined_path / path.name, path.read_bytes())
