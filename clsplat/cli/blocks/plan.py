# SPDX-License-Identifier: Apache-2.0
"""`clsplat blocks plan`: the coarse model of a large scene, its division into blocks, and a picture of it."""

from __future__ import annotations

import sys
from collections.abc import Collection
from contextlib import redirect_stdout
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from tyro.conf import Positional, Suppress, arg

from clsplat.cli.blocks.block_options import DivisionOptions
from clsplat.cli.flags import Groups
from clsplat.cli.options import Output, Verb
from clsplat.cli.session import Services, load_scene
from clsplat.cli.train import TrainVerb
from clsplat.cli.training_run import TrainingMachine
from clsplat.config.checks import parse_bytes
from clsplat.config.presets import Preset, Schedule, by_passes
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError, warn
from clsplat.progress import StageProgress, aligned

if TYPE_CHECKING:
    from clsplat.blocks.plan import BlockPlan, Partition, Point
    from clsplat.runs.run import Run
    from clsplat.scenes.scene import Scene


MIN_BLOCK_PHOTOGRAPHS = 2
"""Smallest limit of the number of photographs of a block."""


@dataclass(frozen=True)
class BlocksPlanVerb(Verb):
    """Divide a large scene into blocks, which can be trained on many machines.

    A coarse model of the whole is trained first. With it, the photographs of each block are found. The same command
    goes on after an interruption.
    """

    groups: ClassVar[Groups] = (
        ("Blocks", ("SCENE", "output", "blocks", "block-*", "up")),
        ("Device and memory", ("device", "max-*", "cache", "scratch")),
        ("Settings of the training, as for clsplat train", ("preset", "schedule", "passes", "*")),
    )

    scene: Annotated[Positional[Path], arg(metavar="SCENE")]
    """Folder with the scene, as for clsplat train."""
    output: Output
    """Folder for the plan, plan.json, its picture, plan.svg, and the coarse model's run, coarse/. Blocks, the merged
    model and the result are written to the same folder later."""
    blocks: Annotated[str, arg(metavar="auto|N|NxM")] = "auto"
    """Number of blocks, or numbers along both axes of the ground. auto: blocks are halved until each is within
    --block-mem and --block-photographs."""
    limits: Annotated[DivisionOptions, arg(name="")] = field(default_factory=DivisionOptions)
    device: Annotated[TrainingMachine, arg(name="")] = field(default_factory=TrainingMachine)
    preset: Preset = "default"
    """Bundle of settings, as for clsplat train."""
    schedule: Schedule | None = None
    """Learning rates and steps of density control, as for clsplat train."""
    passes: Annotated[int | None, arg(metavar="N")] = None
    """Passes through the training photographs, as for clsplat train: of the whole, with all its parts."""
    config: Annotated[TrainConfig, arg(name="")] = field(default_factory=TrainConfig)
    given: Annotated[frozenset[str], Suppress] = field(default=frozenset(), compare=False)
    """Names of the settings given on the command line."""

    def completed(self, given: Collection[str]) -> BlocksPlanVerb:
        """Return the arguments with the settings of preset and schedule. Flags that are `given` override these."""
        train = self.training(self.output, self.config).completed(given)
        return replace(self, config=replace(train.config, batch=self.config.batch), given=frozenset(given))

    def training(self, run: Path, config: TrainConfig) -> TrainVerb:
        """Return the arguments of `clsplat train` for a run on the scene."""
        return TrainVerb(
            run,
            self.scene,
            device=self.device,
            preset=self.preset,
            schedule=self.schedule,
            passes=self.passes,
            config=config,
            given=self.given,
        )


def run(verb: BlocksPlanVerb, services: Services) -> int:
    """Make the plan. Errors in the command line are reported before anything is written."""
    from clsplat.blocks.plan import PLAN_FILE
    from clsplat.blocks.plan_check import check_new_plan, kept_plan
    from clsplat.blocks.planning.coarse import without_density_control
    from clsplat.blocks.planning.new_plan import coarse_run

    division, up = _checked(verb)
    city = verb.output
    check_new_plan(city)
    coarse = coarse_run(city)
    scene, config = _scene(verb, services, coarse)
    plan = kept_plan(city, verb.scene, scene, config, division, up)
    if plan is None:
        try:
            coarse = _trained(verb, services, coarse, scene, config)
            plan = _made(verb, services, coarse, scene, config, (division, up))
        except KeyboardInterrupt as error:
            error.args = (f"before the plan in {city} was made; the same command goes on",)
            raise
    for line in [*plan.joined, *without_density_control(config)]:
        warn(f"{city / PLAN_FILE}: {line}")
    _tell(city, plan)
    return 0


def _checked(verb: BlocksPlanVerb) -> tuple[Partition, Point | None]:
    """Check the flags. Returns the options of the division, and the up direction if it is given."""
    from clsplat.blocks.plan import Partition
    from clsplat.blocks.planning.ground import parse_up
    from clsplat.blocks.planning.split import parse_blocks

    parse_blocks(verb.blocks)
    limits = verb.limits
    for flag, value in (("--block-mem", limits.block_mem), ("--block-photographs", limits.block_photographs)):
        if value is not None and verb.blocks != "auto":
            raise InputError(f"{flag} {value} and --blocks {verb.blocks} exclude each other, expected --blocks auto")
    if limits.block_photographs is not None and limits.block_photographs < MIN_BLOCK_PHOTOGRAPHS:
        raise InputError(f"--block-photographs {limits.block_photographs}: expected at least {MIN_BLOCK_PHOTOGRAPHS}")
    verb.device.check()
    verb.config.check()
    memory = parse_bytes(limits.block_mem, "--block-mem")
    up = parse_up(limits.up) if limits.up is not None else None
    return Partition(verb.blocks, memory, limits.block_photographs), up


def _scene(verb: BlocksPlanVerb, services: Services, coarse: Run | None) -> tuple[Scene, TrainConfig]:
    """Load the scene at the size of the whole. Returns the scene with its start points, and the settings of the whole.

    coarse: run of the coarse model, which keeps the scene's frame; None before it has begun.
    """
    from clsplat.training.preparation import prepared

    frame = verb.config.frame_use if coarse is None else coarse.frame_to_resume()
    scene = load_scene(services, verb.scene, verb.config, frame=frame)
    config = verb.config
    if verb.passes is not None:
        config = by_passes(config, verb.passes, len(scene.require_training_views()), verb.given)
        config.check()
    return prepared(scene, config, coarse), config


def _trained(verb: BlocksPlanVerb, services: Services, coarse: Run | None, scene: Scene, config: TrainConfig) -> Run:
    """Train the coarse model, or go on with its training. Returns its run.

    coarse: the run if it has begun before.
    scene, config: the scene at the size of the whole, and the settings of the whole.
    """
    from clsplat.blocks.plan import COARSE_FOLDER
    from clsplat.blocks.plan_check import check_coarse
    from clsplat.blocks.planning.coarse import coarse_settings
    from clsplat.cli import train
    from clsplat.runs.run import Run

    longest = max(max(view.camera.width, view.camera.height) for view in scene.views)
    wanted = coarse_settings(config, longest)
    training = verb.training(verb.output / COARSE_FOLDER, wanted.on_devices(verb.device.count, explicit=False))
    training = replace(training, passes=None)
    if coarse is None:
        with redirect_stdout(sys.stderr):  # standard output has the table of the plan
            train.run(training, services)
        return Run.open(verb.output / COARSE_FOLDER)
    if check_coarse(coarse, wanted, scene, config):
        print(f"the coarse model in {coarse.path} is trained", file=sys.stderr)
        return coarse
    with redirect_stdout(sys.stderr):
        train.run(replace(training, resume=True, config=coarse.config), services)
    return Run.open(coarse.path)


def _made(
    verb: BlocksPlanVerb,
    services: Services,
    coarse: Run,
    scene: Scene,
    config: TrainConfig,
    options: tuple[Partition, Point | None],
) -> BlockPlan:
    """Divide the scene with the coarse model, and write the plan and its picture.

    options: options of the division, and the up direction if it is given.
    """
    from clsplat.blocks.plan import write_plan
    from clsplat.blocks.planning.ground import ground_of
    from clsplat.blocks.planning.measurement import LoadMeasurement
    from clsplat.blocks.planning.new_plan import coarse_cameras, made_plan
    from clsplat.blocks.planning.picture import plan_svg
    from clsplat.files.atomic import atomic_write
    from clsplat.gaussians import Gaussians
    from clsplat.report import PLAN_PICTURE_FILE
    from clsplat.selftest.result import stages_of_training

    division, up = options
    ground = ground_of(scene, up)
    print(f"{scene.name}: {ground.note}", file=sys.stderr)
    device = services.require(verb.device.open_all(services)[0], stages_of_training(coarse.config))
    model = Gaussians.load(coarse.model_path)
    cameras = coarse_cameras(coarse, scene)
    measurement = LoadMeasurement(scene, ground, model, cameras, device, config, StageProgress())
    plan = made_plan(measurement, coarse, verb.scene, division)
    positions = {view.name: view.camera.position for view in scene.train_views}
    atomic_write(verb.output / PLAN_PICTURE_FILE, plan_svg(plan, positions).encode())
    write_plan(verb.output, plan)
    return plan


def _tell(city: Path, plan: BlockPlan) -> None:
    """Print the table of blocks, and where the plan is."""
    from clsplat.blocks.plan import PLAN_FILE
    from clsplat.blocks.planning.picture import plan_table, plan_total

    print("\n".join(aligned(plan_table(plan))))
    print(plan_total(plan))
    print(f"plan in {city / PLAN_FILE}", file=sys.stderr)
