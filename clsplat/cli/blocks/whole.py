# SPDX-License-Identifier: Apache-2.0
"""`clsplat train --blocks`: plan, blocks, merge and finish, here one after another, or as tasks of processes."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, redirect_stdout
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING

from clsplat.cli.blocks.block_options import DivisionOptions
from clsplat.cli.blocks.city_runs import loader, tell_of_city, trainer
from clsplat.cli.blocks.plan import BlocksPlanVerb
from clsplat.cli.blocks.plan import run as run_plan
from clsplat.cli.session import Services
from clsplat.cli.train import TrainVerb
from clsplat.errors import InputError
from clsplat.progress import TaskProgress

if TYPE_CHECKING:
    from clsplat.blocks.block_training import LoadScene
    from clsplat.blocks.plan import BlockPlan
    from clsplat.config.orientation import FrameUse
    from clsplat.config.training import TrainConfig
    from clsplat.jobs.task import Engine
    from clsplat.scenes.dataset import SceneFrame
    from clsplat.scenes.scene import Scene


def run(verb: TrainVerb, services: Services) -> int:
    """Train a scene in blocks, or go on with it."""
    from clsplat.blocks.plan import read_plan

    _check(verb)
    city = verb.output
    if not verb.resume:
        # with --json, standard output has the JSON alone
        with redirect_stdout(sys.stderr) if verb.json else nullcontext():
            _plan(verb, services)
    plan = read_plan(city)
    if verb.scene is not None and verb.scene.resolve() != plan.scene.resolve():
        raise InputError(
            f"{city}: its plan is of the scene {plan.scene}, not of {verb.scene}; expected that scene or a new folder; "
            "if the scene was moved, repeat the command that began the training, with the new path"
        )
    if verb.blocks.workers is None and verb.blocks.scheduler is None:
        _one_after_another(verb, services, plan)
    else:
        _as_tasks(verb, plan)
    tell_of_city(city, as_json=verb.json)
    print(f"model in {city / 'model.ply'}", file=sys.stderr)
    return 0


def _check(verb: TrainVerb) -> None:
    """Raise InputError for flags that do not fit together. Errors in other flags are found by the plan."""
    options = verb.blocks
    for flag, given in (
        ("--overwrite", verb.overwrite),
        ("--auto", verb.auto),
        ("--view", verb.view),
        ("--frames", verb.frames is not None),
        ("--accept-changes", verb.accept_changes),
    ):
        if given:
            raise InputError(f"{flag} and --blocks exclude each other")
    if verb.resume:
        if wrong := sorted(name for name in verb.given if name in CITY_KEEPS or is_setting(name)):
            flag = wrong[0].replace("_", "-")
            raise InputError(f"--{flag} and --resume exclude each other: {verb.output} keeps the settings of its plan")
    elif options.blocks is None:
        raise InputError(
            f"{verb.output}: has a training in blocks; expected --resume to go on with it, or another folder"
        )
    elif verb.scene is None:
        raise InputError("SCENE is missing, expected the folder of the scene to train on")
    if options.workers is not None and options.scheduler is not None:
        raise InputError("--workers and --scheduler exclude each other: --workers starts processes on this machine")
    if options.workers is not None and options.workers < 1:
        raise InputError(f"--workers {options.workers}: expected at least 1")
    if options.finish is not None and options.finish < 1:
        raise InputError(f"--finish {options.finish}: expected at least 1 step")


CITY_KEEPS = frozenset({"blocks", "block_mem", "block_photographs", "up", "preset", "schedule", "passes"})
"""Options of `clsplat train --blocks`, besides settings, that a training in blocks keeps from its plan."""


def is_setting(name: str) -> bool:
    """True for the name of a setting of a training, such as "density.stop"."""
    from clsplat.config.training import TrainConfig

    try:
        attrgetter(name)(TrainConfig())
    except AttributeError:
        return False
    return True


def _plan(verb: TrainVerb, services: Services) -> None:
    """Train the coarse model and make the plan on this machine, or check that they fit."""
    assert verb.scene is not None, "checked"
    options = verb.blocks
    assert options.blocks is not None, "checked"
    planning = BlocksPlanVerb(
        verb.scene,
        verb.output,
        blocks=options.blocks,
        limits=DivisionOptions(options.block_mem, options.block_photographs, options.up),
        device=verb.device,
        preset=verb.preset,
        schedule=verb.schedule,
        passes=verb.passes,
        config=replace(verb.config, batch=verb.config.batch if "batch" in verb.given else 1),
        given=verb.given,
    )
    run_plan(planning, services)


def _one_after_another(verb: TrainVerb, services: Services, plan: BlockPlan) -> None:
    """Train the blocks here, merge them, and train the merged model. Raises KeyboardInterrupt with advice."""
    from clsplat.blocks.block_training import finish, train_block
    from clsplat.blocks.merging import merge

    load, count = _loading_once(loader(services)), verb.device.count
    train = trainer(services, verb.device)
    for index, block in enumerate(plan.blocks, 1):
        name = block.shown
        with _advice(verb, f"in block {name}, {index} of {len(plan.blocks)}"):
            print(f"block {name}, {index} of {len(plan.blocks)}", file=sys.stderr)
            if not train_block(verb.output, name, load, train, count):
                print(f"block {name} has finished before", file=sys.stderr)
    with _advice(verb, "after the blocks"):
        merge(verb.output)
        finish(verb.output, verb.blocks.finish, load, train, count)


def _loading_once(load: LoadScene) -> LoadScene:
    """Return a function that loads the scene in its first call, and then returns it again: all parts have one scene."""
    scenes: list[Scene] = []

    def loaded(config: TrainConfig, source: Path, frame: FrameUse | SceneFrame) -> Scene:
        if not scenes:
            scenes.append(load(config, source, frame))
        return scenes[0]

    return loaded


@contextmanager
def _advice(verb: TrainVerb, where: str) -> Iterator[None]:
    """Context in which Ctrl-C ends with the command that goes on. where: the stage, in words."""
    try:
        yield
    except KeyboardInterrupt as error:
        more = ["--finish", str(verb.blocks.finish)] if verb.blocks.finish is not None else []
        again = shlex.join(["clsplat", "train", "-o", str(verb.output), "--resume", *more, *verb.device.flags])
        error.args = (f"{where}; go on with: {again}",)
        raise


def _as_tasks(verb: TrainVerb, plan: BlockPlan) -> None:
    """Let processes here, or the workers of a cluster, do the work after the plan. Raises ClsplatError."""
    from clsplat.blocks.progress_records import JOBS_FOLDER
    from clsplat.blocks.tasks import tasks_of
    from clsplat.jobs.dispatcher import run_tasks

    tasks = tasks_of(verb.output, plan, verb.blocks.finish, verb.device.in_any_folder().flags)
    with _engine(verb) as engine, TaskProgress("tasks") as progress:
        needs = [plan.scene, verb.output]
        run_tasks(tasks, engine, verb.output / JOBS_FOLDER, progress, needs=needs)


@contextmanager
def _engine(verb: TrainVerb) -> Iterator[Engine]:
    """Context that yields the engine of the tasks."""
    if verb.blocks.scheduler is None:
        from clsplat.jobs.local_engine import LocalEngine

        yield LocalEngine(verb.blocks.workers or 1)
        return
    from clsplat.jobs.dask_engine import dask_engine

    with dask_engine(verb.blocks.scheduler) as engine:
        yield engine
