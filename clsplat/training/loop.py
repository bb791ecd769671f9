# SPDX-License-Identifier: Apache-2.0
"""Training from start to end: the loop around the trainer's step, and what it leaves in a run's folder."""

from __future__ import annotations

import signal
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config.training import TrainConfig
from clsplat.device import cl
from clsplat.device.child import TrialInterrupted
from clsplat.errors import CapacityError, ClsplatError, DriverError, InputError
from clsplat.evaluation.depths import keep_depths
from clsplat.evaluation.held_out import evaluate
from clsplat.gaussians import Gaussians
from clsplat.images.alpha import background_colour
from clsplat.images.colour import photos_space
from clsplat.process import Interrupted, endings, handled
from clsplat.rendering.memory_plan import Plan
from clsplat.rendering.renderer import Renderer
from clsplat.runs import scene_record
from clsplat.runs.appearance import held_out_looks
from clsplat.runs.checkpoints import unusable
from clsplat.runs.run import Run, check_resumed
from clsplat.scenes import doubts
from clsplat.scenes.cloud import with_points
from clsplat.scenes.depth import with_depths
from clsplat.scenes.initialise import is_colourless, photographed
from clsplat.scenes.scene import Scene
from clsplat.stages.loss import Loss
from clsplat.training import telemetry
from clsplat.training.batch import Losses
from clsplat.training.cameras import aligned
from clsplat.training.health import RETURNS, WINDOW
from clsplat.training.judging import judge
from clsplat.training.refined import doubt_poses, keep_cameras
from clsplat.training.repro import write_bundle
from clsplat.training.trainer import Trainer

REPORT_EVERY = 10
"""Steps between readings of the loss, for which the host waits; the device goes on with the rest of the step."""
HELD = 0.97
"""Part of --density.max-gaussians from which on growth is taken to have ended there: some are pruned since."""


Between = Callable[[Trainer, Callable[[], bool]], None]
"""A function called before each step, with the trainer and a function that is True once Ctrl-C was pressed: then it
should return."""


@dataclass(frozen=True)
class StepReport:
    """step: number of steps done; loss and psnr of that step's view, or of all that its gradient is of; seconds of
    training alone, so far."""

    step: int
    loss: float
    psnr: float
    gaussians: int
    seconds: float


@contextmanager
def _interruption() -> Iterator[Callable[[], int]]:
    """Inside, the first Ctrl-C or other signal to end is noted, and the loop stops between two steps: the function
    gives its number then, and 0 before. After it a Ctrl-C is Python's own, and the other signals do what they did."""
    first = 0

    def ask(number: int, _frame: FrameType | None) -> None:
        nonlocal first
        first = number
        noting.close()

    def asked() -> int:
        if not first:
            for number in before:  # again, as compilers of kernels install handlers of their own
                signal.signal(number, ask)
        return first

    with handled([signal.SIGINT], signal.default_int_handler), ExitStack() as noting:
        before = noting.enter_context(handled((signal.SIGINT, *endings()), ask))
        yield asked


class Session:
    """One call of `clsplat.train`: a trainer, the run that it writes to, and the seconds that it has trained."""

    def __init__(
        self,
        trainer: Trainer,
        run: Run | None,
        on_step: Callable[[StepReport], None] | None,
        on_plan: Callable[[Plan], None] | None,
    ) -> None:
        self.trainer, self.run, self.on_step, self.on_plan = trainer, run, on_step, on_plan
        record = scene_record.read(run) if run is not None else None
        self.scene = scene_record.digest_of(record) if record is not None else None
        self.announced: Plan | None = None
        self.renderer = Renderer(trainer.device, trainer.rasterizer)
        self.seconds = 0.0
        self.began = time.perf_counter()
        self.recorded, self.first_step = False, 0
        self.saved = 0
        self.troubles: Counter[str] = Counter()

    def resume(self) -> None:
        """Go on from the latest checkpoint, if there is one."""
        if self.run is not None and (checkpoint := self.run.load_latest_checkpoint()) is not None:
            self.trainer.restore(checkpoint)
            seconds = checkpoint.state.get("seconds")
            if not isinstance(seconds, float | int):
                raise unusable(checkpoint, f"its state is not as this version writes it (seconds: {seconds!r})")
            self.seconds = float(seconds)
            self.saved = checkpoint.step

    def save(self) -> None:
        """Write a checkpoint, unless this step has one, or the model is not one to go back to."""
        if self.run is not None and self.trainer.step > self.saved:
            arrays, state = self.trainer.checkpoint()
            if not self.trainer.watch.patience.lost:
                state |= {"seconds": self.seconds, **({"scene": self.scene} if self.scene else {})}
                self.run.save_checkpoint(self.trainer.step, arrays, state)
                self.saved = self.trainer.step

    def rescue(self) -> str:
        """Write a checkpoint of the state that the step began with, if that is whole, after a trial that failed or was
        interrupted. The end of a sentence that says so, or nothing."""
        if self.run is None or not self.trainer.step_back():
            return ""
        try:
            self.save()
        except (ClsplatError, OSError, cl.Error) as error:
            return f"; its checkpoint could not be written ({error})"
        if not 0 < self.trainer.step <= self.saved:
            return ""
        resume = f"clsplat train -o {self.run.path} --resume"
        return f"; the checkpoint of step {self.trainer.step} is written: {resume} goes on from it"

    def go_back(self) -> bool:
        """Tell what trouble there was; after too much of it go back to the last checkpoint, with smaller steps, and
        after too much of that raise ClsplatError. True if it went back."""
        trainer, patience = self.trainer, self.trainer.watch.patience
        self.tell_trouble()
        if not patience.over:
            return False
        if patience.spent:
            self.give_up()
        checkpoint = self.run.load_latest_checkpoint() if self.run is not None else None
        stopped = trainer.step
        if checkpoint is not None:
            trainer.restore(checkpoint)
        else:
            trainer.restart()
        trainer.watch.patience = patience.after_return()
        if self.run is not None:
            self.run.truncate_metrics(trainer.step)
            self.saved = -1
            self.save()  # how small the steps are now must outlast a crash
        warnings.warn(
            f"step {stopped}: {len(patience.troubled)} of the last {WINDOW} steps had trouble: back to step "
            f"{trainer.step}, with learning rates of {trainer.watch.patience.rate_factor:g} of what they would be"
        )
        return True

    def tell_trouble(self) -> None:
        """A warning for the first trouble of each stage; the rest is counted."""
        for incident in self.trainer.watch.incidents:
            self.troubles[incident.stage] += 1
            if self.troubles[incident.stage] == 1:
                warnings.warn(f"{incident} (more of this kind will be counted only)")
        self.trainer.watch.incidents.clear()

    def tell_the_rest(self) -> None:
        """Warn of the number of troubled steps that were only counted."""
        self.trainer.mend()
        self.tell_trouble()
        if untold := self.troubles.total() - len(self.troubles):
            warnings.warn(f"{untold} more steps had something that was not finite")

    def give_up(self) -> None:
        """Raise ClsplatError, with what reproduces the trouble in the run's folder."""
        incident = self.trainer.watch.latest
        assert incident is not None, "patience is over only after trouble"
        trouble = f"{incident}, and {RETURNS} returns with smaller steps did not help"
        if self.run is None:
            raise ClsplatError(f"{trouble}: give a run, and what reproduces it is written there")
        path = write_bundle(self.run.path, self.trainer, incident)
        raise ClsplatError(f"{trouble}: {path} reproduces it (python -m clsplat.training.repro)")

    def tell_plan(self) -> None:
        """Tell how the device's memory is used, at first and when more is done in pieces, or less."""
        plan, announced = self.trainer.plan, self.announced
        if self.on_plan is not None and (announced is None or plan.pieces != announced.pieces):
            self.on_plan(plan)
        self.announced = plan

    def report(self, result: Loss | Losses) -> StepReport | None:
        """Read the loss of the step just made; None where it is not finite."""
        start = time.perf_counter()
        value, squared = result.read()
        self.seconds += time.perf_counter() - start
        if not np.isfinite(value):
            self.trainer.watch.loss_failed()
            return None
        psnr = float(-10 * np.log10(max(squared, 1e-12)))
        return StepReport(self.trainer.step, value, psnr, self.trainer.parameters.count, self.seconds)

    def draw(self, camera: Camera) -> tuple[NDArray[Any], NDArray[Any]]:
        """Image and alpha of the model as it is, before the background of evaluations."""
        trainer, background = self.trainer, background_colour(self.trainer.config.background)
        trainer.settle()
        result = self.renderer.render(trainer.parameters, trainer.local(camera), background)
        return result.image, result.alpha

    def render(self, model: Gaussians, camera: Camera) -> tuple[NDArray[Any], NDArray[Any]]:
        """Image over black and alpha of a model on the host."""
        result = Renderer(self.trainer.device, config=self.trainer.config.rasterizer).render(model, camera)
        return result.image, result.alpha

    def evaluate(self, *, keep: bool) -> dict[str, Any]:
        """The held-out views; their renders are kept in the run's test/ if asked for."""
        trainer = self.trainer
        trainer.settle()
        seen = held_out_looks(trainer.appearance.record())
        return evaluate(
            lambda view: seen(view.name, self.draw(view.camera)[0]),
            trainer.cameras.lenses.of_views(trainer.scene.test_views),
            background_colour(trainer.config.background),
            self.run.test_path if keep and self.run is not None else None,
            step=trainer.step,
            gaussians=trainer.parameters.count,
            seconds=self.seconds,
            corrected=trainer.config.appearance != "none",
            aligned=(lambda view: seen(view.name, self.draw(aligned(trainer, view, seen))[0]))
            if trainer.cameras.poses.on and keep
            else None,
            space=photos_space(view.path for view in trainer.scene.views),
        )

    def record(
        self, report: StepReport, *, evaluating: bool, stages: dict[str, float] | None, judged: bool = False
    ) -> None:
        """Hand the report on, and write it down with what clsplat.report asks for."""
        if self.on_step is not None:
            self.on_step(report)
        record = asdict(report)
        if evaluating:
            record["eval"] = self.evaluate(keep=False)
        if self.run is None:
            return
        trainer = self.trainer
        if stages is not None:
            record["stages"] = stages
        if judged:
            record["gate"] = trainer.cameras.gate.record()
        if not self.recorded:
            record["session"] = telemetry.session(trainer.device, self.first_step)
            self.recorded = True
        last = trainer.step == trainer.config.iterations
        if last and trainer.config.report and (histogram := telemetry.contributions(trainer)) is not None:
            record["contributions"] = histogram
        self.run.append_metrics({**record, "elapsed": time.perf_counter() - self.began})

    def doubt(self) -> None:
        """A warning if the renders show nothing; no look at them if the memory is too small for one."""
        with suppress(CapacityError):
            if text := doubts.of_pictures(self.draw, self.trainer.views):
                warnings.warn(f"step {self.trainer.step}: {text}")

    def times_stages(self, steps: range) -> bool:
        """True if each stage of these steps, which are made together, is to be timed: only where the times are written
        down."""
        config = self.trainer.config
        if config.stages_every == 0:
            return False
        return config.iterations in steps or (_reached(config.stages_every, steps) and _reached(REPORT_EVERY, steps))

    def evaluates(self, steps: range) -> bool:
        """True if the held-out views are rendered after these steps."""
        return any(step in steps for step in self.trainer.config.eval_at) and bool(self.trainer.scene.test_views)

    def reports(self, steps: range) -> bool:
        """True if the loss of these steps is read."""
        asked = self.evaluates(steps) or self.trainer.cameras.gate.is_due(steps[-1])
        return _reached(REPORT_EVERY, steps) or self.trainer.config.iterations in steps or asked

    def step(self) -> None:
        """One step, or those of a batch, and what is due after it."""
        trainer, config = self.trainer, self.trainer.config
        start, stages = time.perf_counter(), None
        steps = range(trainer.step + 1, trainer.step + 1 + trainer.views_ahead)
        reports = self.reports(steps)
        if self.run is not None and self.times_stages(steps):
            result, stages = telemetry.timed(trainer.device, lambda: trainer.train_step(reads_loss=reports))
        else:
            result = trainer.train_step(reads_loss=reports)
        self.seconds += time.perf_counter() - start
        self.tell_plan()
        if trainer.step == config.iterations:
            trainer.mend(look=True)
        if self.go_back():
            return
        judged = judge(trainer)
        if doubts.LOOK_AT in steps and trainer.step < config.iterations:
            self.doubt()
        if reports:
            evaluating = self.evaluates(steps)
            report = self.report(result)
            if report is not None:
                self.record(report, evaluating=evaluating, stages=stages, judged=judged)
        if config.checkpoint_every > 0 and _reached(config.checkpoint_every, steps):
            self.save()

    def train(self, between: Between | None) -> Gaussians:
        """Make the steps that are left, and write down the model and its evaluation."""
        trainer, run = self.trainer, self.run
        self.first_step = trainer.step
        _tell_idle_settings(trainer)
        self.tell_plan()
        try:
            self.make_steps(between)
        except (DriverError, TrialInterrupted) as error:  # with a checkpoint nothing is lost
            written = self.rescue()
            if written and isinstance(error, DriverError):
                raise DriverError(f"{error}{written}") from error
            raise
        trainer.finish()
        model = trainer.gaussians()
        if run is not None:
            run.save_model(model, photos_space(view.path for view in trainer.scene.views))
            if (appearance := trainer.appearance.record()) is not None:
                run.write_appearance(appearance, trainer.appearance.tables())
            if trainer.config.refines:
                keep_cameras(run, trainer)
            if trainer.scene.test_views:
                result = self.evaluate(keep=True)
                run.write_eval(result)
                doubt_poses(result["mean"], trainer.config.refine_gate)
                ample = trainer.device.memory.limit is None and not any(trainer.plan.pieces)
                if trainer.config.report and ample:
                    with suppress(CapacityError, DriverError):  # a picture less is no failed training
                        views = trainer.cameras.lenses.of_views(trainer.scene.test_views)
                        keep_depths(self.render, model, views, result["views"], run.depth_path)
        return model

    def make_steps(self, between: Between | None) -> None:
        """All steps that are left, and what is due at their end. Raises Interrupted, after a checkpoint."""
        trainer, last = self.trainer, self.trainer.config.iterations
        with _interruption() as interrupted:
            while True:
                while trainer.step < last and not interrupted():
                    if between is not None:
                        between(trainer, lambda: interrupted() != 0)
                    self.step()
                self.save()
                if trainer.step < last or not self.go_back():
                    break
            self.tell_the_rest()
            if trainer.step < last:
                raise Interrupted(interrupted())
            self.doubt()
            _tell_of_limit(trainer)


def _tell_of_limit(trainer: Trainer) -> None:
    """Warn where a limit has held the paper's growth, which began under it."""
    density, scene = trainer.config.density, trainer.scene
    most, began = HELD * density.max_gaussians, len(scene.points) or trainer.config.random_points
    if density.growth == "paper" and began < most <= trainer.parameters.count:
        warnings.warn(
            f"--density.max-gaussians {density.max_gaussians:,} has held the growth: --density.growth mcmc, or budget "
            "with --density.long-axis, shows more with as many Gaussians"
        )


def _reached(every: int, steps: range) -> bool:
    """True if one of the steps is a multiple of `every`."""
    return steps[-1] // every > (steps[0] - 1) // every


def begin(scene: Scene, config: TrainConfig, run: Run | None, *, resume: bool) -> Scene:
    """The scene to train on, with colours, recorded in the run; a warning for each doubt in it. Raises InputError where
    the run has been trained already, or on another scene."""
    scene = with_depths(with_points(scene, config.start_points), config.depth_use)
    if run is not None:
        if not resume and (run.checkpoints() or run.read_metrics()):
            raise InputError(
                f"{run.path}: has been trained already; resume=True goes on with it, Run.create(..., overwrite=True) "
                "starts again"
            )
        run.keep_config(config)
        if resume:
            scene_record.check(run, scene, run.scene or Path(scene.name), config.resolution)
        scene_record.keep(run, scene, resuming=resume)
        if resume and run.checkpoints():
            return scene
    for text in doubts.of_scene(scene, config.background):
        warnings.warn(text)
    if is_colourless(scene):
        warnings.warn(f"{scene.name}: the points have no colours, those of the photographs are taken for them")
        scene = replace(scene, point_colors=photographed(scene, background_colour(config.background)))
    return scene


def checked(scene: Scene, config: TrainConfig | None, run: Run | None, *, resume: bool) -> TrainConfig:
    """The settings. Raises InputError where the arguments of `clsplat.train` make no sense."""
    for name, value, kind, meant in (
        ("scene", scene, Scene, "clsplat.load_scene(...)"),
        ("config", config, TrainConfig | None, "TrainConfig(...)"),
        ("run", run, Run | None, "Run.create(...)"),
    ):
        if not isinstance(value, kind):
            raise InputError(f"{name} is {value!r:.100}, expected {meant}")
    if resume and run is None:
        raise InputError("resume=True: expected run=..., the run to go on with")
    if config is None:
        config = run.config if run is not None else TrainConfig()
    config.check()
    if resume and run is not None:
        check_resumed(run, config)
        if (done := max((step for step, _ in run.checkpoints()), default=0)) > config.iterations:
            raise InputError(f"iterations {config.iterations}: {run.path} is at step {done} already, expected more")
    scene.require_training_views()
    return config


def late_settings(config: TrainConfig) -> Iterator[str]:
    """A line for each setting that is not the default and comes after the last step, or begins before the first."""
    last, expected = config.iterations, f"expected at most --iterations {config.iterations}"
    ends = f"training ends at step {last}"
    if steps := [step for step in config.density.prune_at if step > last]:
        yield f"--density.prune-at {','.join(map(str, steps))}: nothing is pruned then, {ends}; {expected}"
    density = config.density
    if density.every and density.growth != "paper" and density.stop > last:
        yield (
            f"--density.growth {density.growth}: --density.max-gaussians {density.max_gaussians:,} is reached at "
            f"--density.stop {density.stop}, {ends}; {expected}, such as {5 * last // 7}"
        )
    optimiser = config.optimiser
    if optimiser.cooldown > last:
        part = optimiser.cooldown_to ** (1 - last / optimiser.cooldown)
        yield (
            f"--optimiser.cooldown {optimiser.cooldown}: the learning rates begin at {part:.2g} of what they are, "
            f"training has {last} steps; {expected}"
        )
    if config.frequency_steps > last:
        rise = "the training resolution does not rise to the full size"
        yield f"--frequency-steps {config.frequency_steps}: {rise}, {ends}; {expected}"
    elif (
        not config.frequency_steps
        and tuple(config.warmup) != TrainConfig.warmup
        and (steps := [step for step in config.warmup if step >= max(last, 2)])
    ):
        yield (
            f"--warmup {','.join(map(str, steps))}: the training resolution does not double then, {ends} at "
            f"1/{2 ** len(steps)} of the size; expected less than --iterations {last}"
        )


def _tell_idle_settings(trainer: Trainer) -> None:
    """A warning for each setting that comes to nothing with this scene."""
    config, count = trainer.config, trainer.parameters.count
    for text in late_settings(config):
        warnings.warn(text)
    if config.eval_at and not trainer.scene.test_views:
        steps = ",".join(map(str, config.eval_at))
        warnings.warn(f"--eval-at {steps}: no view is held out, so that nothing is evaluated; see --test-every")
    if trainer.step == 0 and config.density.every and count > config.density.max_gaussians:
        warnings.warn(
            f"training begins with {count:,} Gaussians, more than --density.max-gaussians "
            f"{config.density.max_gaussians:,}, which stops new ones only: give the scene fewer points"
        )
