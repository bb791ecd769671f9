# SPDX-License-Identifier: Apache-2.0
"""`clsplat train`: flags, checks and progress of a training, new or resumed."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Collection
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, Suppress, arg

from clsplat.cli.blocks.block_options import WholeInBlocks
from clsplat.cli.eval import print_summary
from clsplat.cli.options import Flag, OptionalInt, Output, PageOptions, Verb, with_given
from clsplat.cli.session import Services, load_scene
from clsplat.cli.training_run import TrainingMachine, tell_of_training, train_run
from clsplat.config.presets import Preset, Schedule, bundled, by_passes, steps_made_for
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError, warn
from clsplat.files.documents import open_input

if TYPE_CHECKING:
    from clsplat.runs.run import Run
    from clsplat.scenes.scene import Scene


@dataclass(frozen=True)
class TrainVerb(Verb):
    """Train a scene. Ctrl-C, SIGTERM and SIGHUP write a checkpoint first; --resume continues from the latest.

    With --resume the run keeps its settings, except for those given as flags.
    """

    output: Output
    """Folder for the run: config.toml, scene.json, model.ply, metrics.jsonl, eval.json, report.html, checkpoints/,
    test/."""
    scene: Annotated[Positional[Path | None], arg(metavar="SCENE")] = None
    """Folder with the scene: COLMAP, Blender, nerfstudio, instant-ngp, a survey of OpenSfM, WebODM, Metashape or
    RealityScan, or just photos, videos or both; or a video. Not needed with --resume."""
    frames: OptionalInt = None
    """Number of frames to take from each video, as with clsplat sfm --frames. If not given: frames that were taken
    before are used, of any number; otherwise length and motion decide."""
    resume: Flag = False
    """Continue the run in the output folder."""
    accept_changes: Flag = False
    """With --resume: continue although the scene or a photograph has changed since the run began."""
    overwrite: Flag = False
    """Replace the run in the output folder. Files that clsplat did not write stay."""
    device: Annotated[TrainingMachine, arg(name="")] = field(default_factory=TrainingMachine)
    view: Flag = False
    """Show the growing model on a page in the browser, where training can be paused too (see clsplat view)."""
    page: Annotated[PageOptions, arg(name="")] = field(default_factory=PageOptions)
    blocks: Annotated[WholeInBlocks, arg(name="")] = field(default_factory=WholeInBlocks)
    auto: Flag = False
    """Adapt settings to findings on the scene, such as --appearance exposure if the photographs' exposures differ.
    Settings given as flags stay. The findings are printed even without --auto."""
    json: Flag = False
    """Print the final evaluation as JSON on standard output."""
    preset: Preset = "default"
    """Bundle of settings. exact and default are the same and approximate nothing. fast takes less than half of the
    time, and lost at most 0.3 dB of PSNR on the scenes used for tuning. Flags override it."""
    schedule: Schedule | None = None
    """Learning rates, and the steps at which SH degrees rise and density control ends. paper is made for 30,000 steps,
    short and high-rates for about 7000. high-rates has higher rates than short, and pays off below about 60 steps per
    photograph. Flags override it. If not given: paper, but short with --preset fast."""
    passes: Annotated[int | None, arg(metavar="N")] = None
    """Passes through the training photographs. Sets --iterations to N times their number, and stretches or shortens the
    schedule in the same way: densification, SH degrees, opacity resets, warm-up sizes, learning rates and cooldown.
    Flags for these override it."""
    config: Annotated[TrainConfig, arg(name="")] = field(default_factory=TrainConfig)
    given: Annotated[frozenset[str], Suppress] = field(default=frozenset(), compare=False)
    """Names of the settings given on the command line."""

    def completed(self, given: Collection[str]) -> TrainVerb:
        """Return the arguments with the settings of the resumed run, or of preset and schedule. Flags that are `given`
        override these. A batch of 1 becomes one view per device."""
        if self.resume and self.in_blocks:
            return replace(self, given=frozenset(given))
        verb = self._with_settings(given)
        if "points" in given and verb.config.points:  # an absolute path, so that the run can be resumed from any folder
            verb = replace(verb, config=replace(verb.config, points=str(Path(verb.config.points).absolute())))
        explicit = self.resume or "batch" in given
        config = verb.config.on_devices(self.device.count, explicit=explicit)
        return replace(verb, config=config, given=frozenset(given))

    @property
    def in_blocks(self) -> bool:
        """True if the scene is trained in blocks: with --blocks, or if the output folder has a plan."""
        from clsplat.blocks.plan import COARSE_FOLDER, PLAN_FILE
        from clsplat.runs.run import is_run

        if self.blocks.blocks is not None:
            return True
        return (self.output / PLAN_FILE).exists() or is_run(self.output / COARSE_FOLDER)

    def _with_settings(self, given: Collection[str]) -> TrainVerb:
        if self.passes is not None:
            by_passes(self.config, self.passes, photographs=1)  # report an invalid number before the scene is read
            if "iterations" in given:
                raise InputError(
                    f"--passes {self.passes} and --iterations {self.config.iterations} exclude each other: both set "
                    "the number of steps"
                )
        if not self.resume and (self.preset, self.schedule) == ("default", None):
            return self
        if not self.resume:
            steps = self.config.iterations if self.passes is None else steps_made_for(self.preset, self.schedule)
            return replace(self, config=with_given(bundled(self.preset, self.schedule, steps), self.config, given))
        from clsplat.runs.run import Run, check_output

        bundles = (("preset", self.preset, "default"), ("schedule", self.schedule, None), ("passes", self.passes, None))
        for flag, value, usual in bundles:
            if value != usual:
                raise InputError(f"--{flag} {value} and --resume exclude each other: a resumed run keeps its settings")
        check_output(self.output, resume=True, overwrite=self.overwrite)
        return replace(self, config=with_given(Run.open(self.output).config, self.config, given))


def _check_not_in_blocks(verb: TrainVerb) -> None:
    """Raise InputError for a flag that only --blocks uses."""
    for name in ("block_mem", "block_photographs", "up", "workers", "scheduler", "finish"):
        if (value := getattr(verb.blocks, name)) is not None:
            raise InputError(f"--{name.replace('_', '-')} {value}: is for trainings in blocks, expected --blocks too")


def _check_used(config: TrainConfig, given: Collection[str]) -> None:
    """Raise InputError for a flag whose feature is off, such as --pose-reach without --refine-poses."""
    for name, used, why, wanted in (
        ("depth_unit", config.depth == "maps", "no depth maps are used", "depth maps"),
        ("depth_weight", config.depth != "none", "no depths are used", "depth"),
        ("pose_reach", config.refine_poses, "poses are not refined", "refine-poses"),
        ("lens_reach", config.refine_lenses, "lenses are not refined", "refine-lenses"),
        ("appearance_rate", config.appearance != "none", "no appearance is learnt", "appearance"),
    ):
        if name in given and not used and getattr(config, name) != getattr(TrainConfig, name):
            flag = name.replace("_", "-")
            raise InputError(f"--{flag} {getattr(config, name)}: {why}, expected --{wanted} too")


def run(verb: TrainVerb, services: Services) -> int:
    """Train a new run or resume one. Errors in the command line are reported before the run's folder is changed."""
    if verb.in_blocks:
        from clsplat.cli.blocks import whole

        return whole.run(verb, services)
    _check_not_in_blocks(verb)
    from clsplat.runs.locks import locked
    from clsplat.runs.run import check_output, is_run

    with ExitStack() as locks:
        if is_run(verb.output):
            locks.enter_context(locked(verb.output, "train"))
        check_output(verb.output, resume=verb.resume, overwrite=verb.overwrite)
        if verb.accept_changes and not verb.resume:
            raise InputError("--accept-changes is for --resume, expected both")
        if verb.output.is_dir():
            locks.enter_context(locked(verb.output, "train"))
        return _train(verb, services, locks)


def _train(verb: TrainVerb, services: Services, locks: ExitStack) -> int:
    """Check the flags, load the scene, and train or resume the run.

    locks: locks that are held until training ends. The lock of a new run folder is added.
    """
    from clsplat.runs import scene_record
    from clsplat.runs.locks import locked
    from clsplat.runs.run import Run, check_resumed
    from clsplat.selftest.result import stages_of_training
    from clsplat.training.preparation import check_steps_left

    verb.device.check()
    verb.config.check()
    _check_used(verb.config, verb.given)
    if verb.frames is not None and verb.frames < 1:
        raise InputError(f"--frames {verb.frames}: expected at least 1")
    page = None
    if verb.view:
        from clsplat.cli.view import training_view

        page = training_view(verb.page)
    source, earlier = verb.scene, None
    if verb.resume:
        earlier = Run.open(verb.output)
        check_resumed(earlier, verb.config)
        source = source or earlier.scene
    if source is None:
        raise InputError("SCENE is missing, expected the folder of the scene to train on")
    if verb.resume and verb.auto:
        raise InputError("--auto and --resume exclude each other: a resumed run keeps its settings")
    devices = verb.device.open_all(services)
    scene, config = _looked_at(verb, services, source, earlier)
    if earlier is not None:
        check_steps_left(earlier, config, "--iterations")
    if len(scene.points) == 1:  # initial sizes are distances between points
        warn(f"{source}: has a single point, expected several: training starts with one Gaussian of almost no size")
    changed = earlier is not None and scene_record.check(
        earlier, scene, source, config.resolution, accept=verb.accept_changes
    )
    stages = stages_of_training(config)
    devices = [services.require(device, stages) for device in devices]
    verb.device.check_memory(scene, config, devices[0])
    verb.output.mkdir(parents=True, exist_ok=True)
    locks.enter_context(locked(verb.output, "train"))
    run = Run.create(verb.output, config, scene=source, resume=verb.resume, overwrite=verb.overwrite)
    run.resume_command = shlex.join([*shlex.split(run.resume_command), *verb.device.flags])
    if changed:
        scene_record.write(run, scene)
    tell_of_training(scene, config, devices)
    train_run(services, scene, run, devices, verb.device, page=page)
    result = json.loads(run.eval_path.read_text("utf-8")) if run.eval_path.exists() else None
    if verb.json:
        print(json.dumps(result, indent=2))
    elif result is not None:
        print_summary(result)
    print(f"model in {run.model_path}", file=sys.stderr)
    return 0


def _looked_at(verb: TrainVerb, services: Services, source: Path, earlier: Run | None) -> tuple[Scene, TrainConfig]:
    """Load the scene, and print the findings about it. Returns the scene and the settings to train with.

    source: the scene's folder.
    earlier: the run to continue; None for a new run.
    With --auto the settings are adapted to the findings.
    """
    from clsplat.scenes.analysis.recommendations import answered, paragraph

    config = verb.config
    scene = _scene(services, source, config, earlier, verb.frames)
    if earlier is not None:
        return scene, config
    photographs = len(scene.train_views)
    if verb.passes is not None:
        config = by_passes(config, verb.passes, photographs, verb.given)
        config.check()
    findings = services.findings(scene, config.mask_use, config.iterations)
    answers, better = answered(findings, config, verb.given, photographs)
    print(paragraph(answers, len(scene.views), auto=verb.auto, sampled=len(scene.sampled_views)), file=sys.stderr)
    if not verb.auto:
        return scene, config
    if (better.mask_use, better.lenses) != (config.mask_use, config.lenses):
        scene = _scene(services, source, better, None, verb.frames)
    return scene, better


def _scene(services: Services, source: Path, config: TrainConfig, earlier: Run | None, frames: int | None) -> Scene:
    """Load the training scene with its initial points. Raises InputError if training on it would fail.

    source: the scene's folder, or a video.
    earlier: the run to continue; None for a new run.
    frames: number of frames to take from each video, as for `load_scene`.
    """
    from clsplat.training.preparation import prepared

    if config.points:  # check the file before the scene is loaded: structure from motion may take hours
        with open_input(Path(config.points), "a cloud of points"):
            pass
    scene = load_scene(
        services,
        source,
        config,
        frame=config.frame_use if earlier is None else earlier.frame_to_resume(),
        frames=frames,
    )
    scene = prepared(scene, config, earlier)
    _check_scene(scene)
    return scene


def _check_scene(scene: Scene) -> None:
    """Raise InputError for a held-out view that is too small for SSIM, or for a picture that does not decode."""
    from clsplat.evaluation.metrics import SSIM_WINDOW_PX

    for view in scene.test_views:
        if min(view.camera.width, view.camera.height) < SSIM_WINDOW_PX:
            raise InputError(
                f"{view.path}: has {view.camera.width}x{view.camera.height} pixels at this --resolution, expected at "
                f"least {SSIM_WINDOW_PX} pixels per side to measure SSIM"
            )
    scene.check_pictures()
