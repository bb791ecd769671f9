# SPDX-License-Identifier: Apache-2.0
"""The training loop: steps, reports, evaluations and checkpoints, with its output in a run's folder.

`training.stability.health` has the limits at which non-finite values lead back to a checkpoint, or end the training.
"""

from __future__ import annotations

import signal
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.chunks.slot_file import ScratchError
from clsplat.device.drivers.worker_process import TrialInterrupted
from clsplat.errors import CapacityError, ClsplatError, DriverError, InputError
from clsplat.evaluation.depths import keep_depths
from clsplat.evaluation.held_out import EvaluatedModel, Evaluation, evaluate
from clsplat.gaussians import Gaussians, GaussiansOfFile
from clsplat.images.alpha import background_colour
from clsplat.images.colour import photos_space
from clsplat.process import Interrupted, endings, handled
from clsplat.rendering.memory_plan import Plan
from clsplat.rendering.renderer import Renderer
from clsplat.runs import scene_record
from clsplat.runs.appearance import held_out_looks
from clsplat.runs.checkpoints import unusable
from clsplat.runs.run import Run
from clsplat.scenes.analysis import sanity_checks
from clsplat.stages.loss import Loss
from clsplat.training import telemetry
from clsplat.training.batches.batch import Losses
from clsplat.training.cameras.export import doubt_poses
from clsplat.training.held_out_alignment import aligned
from clsplat.training.preparation import late_settings
from clsplat.training.repro_bundle import write_bundle
from clsplat.training.stability.health import MAX_CHECKPOINT_RETURNS, TROUBLE_WINDOW_STEPS
from clsplat.training.trainer import Trainer

REPORT_EVERY = 10
"""Number of steps between reports, and lines of metrics.jsonl, for which the host reads the loss. While it waits, the
device continues with the rest of the step."""
GROWTH_LIMIT_FRACTION = 0.97
"""Fraction of --density.max-gaussians from which growth counts as limited. It is below 1 because some Gaussians are
pruned after the limit is reached."""
OVERFITTING_DB = 0.2
"""Fall of the held-out views' mean PSNR, in dB, from which a warning reports overfitting.

The PSNRs of trainings that differ only in the seed differ by as much (docs/quality.md).
"""


Between = Callable[[Trainer, Callable[[], bool]], None]
"""Function called before each step, with the trainer and a predicate. The predicate becomes True after Ctrl-C, and the
function should then return."""


@dataclass(frozen=True)
class StepReport:
    """Report of a training step.

    step: number of steps done.
    loss, psnr: loss and PSNR of the step's view. In a batch, the mean loss, and the PSNR of the mean squared error.
    seconds: training time so far, without the time of evaluations, checkpoints and other work.
    """

    step: int
    loss: float
    psnr: float
    gaussians: int
    seconds: float


@contextmanager
def _interruption() -> Iterator[Callable[[], int]]:
    """Context in which the first Ctrl-C or other termination signal stops the loop only between two steps.

    It yields a function that returns the signal's number, or 0 before a signal. After the first signal, Python handles
    Ctrl-C again, and the other signals have their previous handlers.
    """
    first = 0

    def ask(number: int, _frame: FrameType | None) -> None:
        nonlocal first
        first = number
        noting.close()

    def asked() -> int:
        if not first:
            for number in before:  # kernel compilers may have replaced these handlers by their own
                signal.signal(number, ask)
        return first

    with handled([signal.SIGINT], signal.default_int_handler), ExitStack() as noting:
        before = noting.enter_context(handled((signal.SIGINT, *endings()), ask))
        yield asked


class TrainingSession:
    """State of one call of `clsplat.train`: the trainer, its run (None to write no files), and the training time."""

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
        self.seconds = 0.0
        self.began = time.perf_counter()
        self.recorded, self.first_step = False, 0
        self.saved = 0
        self.troubles: Counter[str] = Counter()

    def resume(self) -> None:
        """Continue from the latest checkpoint, if there is one."""
        if self.run is not None and (checkpoint := self.run.load_latest_checkpoint()) is not None:
            self.trainer.restore(checkpoint)
            seconds = checkpoint.state.get("seconds")
            if not isinstance(seconds, float | int):
                raise unusable(checkpoint, f"its training time is {seconds!r}, expected a number of seconds")
            self.seconds = float(seconds)
            self.saved = checkpoint.step

    def save(self) -> None:
        """Write a checkpoint, unless the current step already has one, or too many Gaussians have non-finite values."""
        if self.run is not None and self.trainer.step > self.saved:
            arrays, state = self.trainer.checkpoint()
            if not self.trainer.monitor.retries.lost:
                state |= {"seconds": self.seconds, **({"scene": self.scene} if self.scene else {})}
                self.run.save_checkpoint(self.trainer.step, arrays, state)
                self.trainer.model.saved_now()
                self.saved = self.trainer.step

    def rescue(self) -> str:
        """Write a checkpoint of the state at the start of the step, unless the step has already changed the model.

        Called if a kernel's trial or the driver fails (as with a lost GPU), if device memory is used up, and if a
        photograph cannot be read. Returns the end of an error message, which names the checkpoint, or "".
        """
        if self.run is None:
            return ""
        earlier = self.last_one
        if not self.trainer.step_back():
            return earlier
        try:
            self.save()
        except (ClsplatError, OSError) as error:
            return f"; no checkpoint could be written ({error}){earlier}"
        if not 0 < self.trainer.step <= self.saved:
            return ""
        return f"; a checkpoint of step {self.trainer.step} is written: {self.run.resume_command} continues from it"

    @property
    def last_one(self) -> str:
        """End of an error message, which names the command that continues from the last checkpoint, or ""."""
        there = self.run is not None and self.run.checkpoints()
        return f"; {self.run.resume_command} continues from the last checkpoint" if self.run and there else ""

    def go_back(self) -> bool:
        """Report non-finite values. After too many steps with them, go back to the last checkpoint, and continue with
        smaller learning rates.

        Returns True if training went back. Raises ClsplatError after too many returns.
        """
        trainer, retries = self.trainer, self.trainer.monitor.retries
        self.tell_trouble()
        if not retries.over:
            return False
        if retries.spent:
            self.give_up()
        checkpoint = self.run.load_latest_checkpoint() if self.run is not None else None
        stopped = trainer.step
        if checkpoint is not None:
            trainer.restore(checkpoint)
        else:
            trainer.restart()
        trainer.monitor.retries = retries.after_return()
        if self.run is not None:
            self.run.truncate_metrics(trainer.step)
            self.saved = -1
            self.save()  # a crash must not lose the smaller `rate_factor` of `retries`
        warnings.warn(
            f"step {stopped}: {len(retries.troubled)} of the last {TROUBLE_WINDOW_STEPS} steps had "
            "values that were not finite: "
            f"training returns to step {trainer.step}, with learning rates multiplied "
            f"by {trainer.monitor.retries.rate_factor:g}"
        )
        return True

    def tell_trouble(self) -> None:
        """Warn of the first incident with non-finite values in each stage, and count the later ones."""
        for incident in self.trainer.monitor.incidents:
            self.troubles[incident.stage] += 1
            if self.troubles[incident.stage] == 1:
                warnings.warn(f"{incident} (further incidents of this kind are only counted)")
        self.trainer.monitor.incidents.clear()

    def tell_the_rest(self) -> None:
        """Warn of the number of further steps with non-finite values, which `tell_trouble` only counted."""
        self.trainer.repair()
        self.tell_trouble()
        if untold := self.troubles.total() - len(self.troubles):
            warnings.warn(f"{untold} more steps had values that were not finite")

    def give_up(self) -> None:
        """Raise ClsplatError. Before that, write a bundle that reproduces the non-finite values to the run, if any."""
        incident = self.trainer.monitor.latest
        assert incident is not None, "retries are used up only by steps with non-finite values"
        trouble = (
            f"{incident}, and {MAX_CHECKPOINT_RETURNS} returns to a checkpoint with smaller learning rates did not help"
        )
        if self.run is None:
            raise ClsplatError(f"{trouble}: to get a file that reproduces the step, give clsplat.train a run=...")
        path = write_bundle(self.run.path, self.trainer, incident)
        raise ClsplatError(f"{trouble}: {path} reproduces the step (python -m clsplat.training.repro_bundle)")

    def tell_plan(self) -> None:
        """Report the memory plan at the start, and whenever work has to be split into pieces or no longer has to be."""
        plan, announced = self.trainer.plan, self.announced
        if self.on_plan is not None and (announced is None or plan.pieces != announced.pieces):
            self.on_plan(plan)
        self.announced = plan

    def report(self, result: Loss | Losses) -> StepReport | None:
        """Read the loss of the latest step, and return the step's report; None if the loss is not finite."""
        start = time.perf_counter()
        value, squared = result.read()
        self.seconds += time.perf_counter() - start
        if not np.isfinite(value):
            self.trainer.monitor.loss_failed()
            return None
        psnr = float(-10 * np.log10(max(squared, 1e-12)))
        return StepReport(self.trainer.step, value, psnr, self.trainer.parameters.count, self.seconds)

    def draw(self, camera: Camera) -> tuple[NDArray[Any], NDArray[Any]]:
        """Render the current model over the background of evaluations. Returns image and alpha."""
        result = self.trainer.draw(camera)
        return result.image, result.alpha

    def render(self, model: Gaussians, camera: Camera) -> tuple[NDArray[Any], NDArray[Any]]:
        """Render `model`, which is in main memory or in a file, over black. Returns image and alpha."""
        result = Renderer(self.trainer.device, config=self.trainer.config.rasterizer).render(model, camera)
        return result.image, result.alpha

    def evaluate(self, *, keep: bool) -> Evaluation:
        """Evaluate the held-out views.

        keep: True to save their renders in RUN/test/, and to measure them at aligned poses too if poses are refined.
        """
        trainer = self.trainer
        trainer.settle()
        seen = held_out_looks(trainer.appearance.record())
        return evaluate(
            lambda view: seen(view.name, self.draw(view.camera)[0]),
            trainer.cameras.lenses.of_views(trainer.scene.test_views),
            background_colour(trainer.config.background),
            self.run.test_path if keep and self.run is not None else None,
            model=EvaluatedModel(trainer.step, trainer.parameters.count, self.seconds),
            corrected=trainer.config.appearance != "none",
            aligned=(lambda view: seen(view.name, self.draw(aligned(trainer, view, seen))[0]))
            if trainer.cameras.poses.on and keep
            else None,
            space=photos_space(view.path for view in trainer.scene.views),
        )

    def record(
        self, report: StepReport, *, evaluating: bool, stages: dict[str, float] | None, validated: bool = False
    ) -> None:
        """Pass a step's report to `on_step`, and append it to metrics.jsonl, with other values that report.html shows.

        evaluating: True to evaluate the held-out views for the record.
        stages: milliseconds by stage; None if the step was not timed.
        validated: True if the refined cameras have been validated after the step.
        """
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
        if validated:
            record["gate"] = trainer.cameras.gate.record()
        if not self.recorded:
            record["session"] = telemetry.session(trainer.device, self.first_step)
            self.recorded = True
        last = trainer.step == trainer.config.iterations
        if last and trainer.config.report and (histogram := telemetry.contributions(trainer)) is not None:
            record["contributions"] = histogram
        self.run.append_metrics({**record, "elapsed": time.perf_counter() - self.began})

    def doubt(self) -> None:
        """Warn if renders of training views show nothing. Nothing is checked if there is too little memory to
        render."""
        with suppress(CapacityError):
            if text := sanity_checks.of_pictures(self.draw, self.trainer.views):
                warnings.warn(f"step {self.trainer.step}: {text}")

    def times_stages(self, steps: range) -> bool:
        """True if the stages of a training step have to be timed for the report. steps: numbers of the step's views."""
        config = self.trainer.config
        if config.stages_every == 0:
            return False
        return config.iterations in steps or (_reached(config.stages_every, steps) and _reached(REPORT_EVERY, steps))

    def evaluates(self, steps: range) -> bool:
        """True if held-out views are rendered after a training step. steps: numbers of the step's views."""
        return any(step in steps for step in self.trainer.config.eval_at) and bool(self.trainer.scene.test_views)

    def reports(self, steps: range) -> bool:
        """True if the loss of a training step is read. steps: numbers of the step's views."""
        asked = self.evaluates(steps) or self.trainer.cameras.gate.is_due(steps[-1])
        return _reached(REPORT_EVERY, steps) or self.trainer.config.iterations in steps or asked

    def step(self) -> None:
        """Run one step, or a batch of them, and the work that is due afterwards."""
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
            trainer.repair(look=True)
        if self.go_back():
            return
        validated = trainer.validate()
        if sanity_checks.FIRST_RENDER_CHECK_STEP in steps and trainer.step < config.iterations:
            self.doubt()
        if reports:
            evaluating = self.evaluates(steps)
            report = self.report(result)
            if report is not None:
                self.record(report, evaluating=evaluating, stages=stages, validated=validated)
        if config.checkpoint_every > 0 and _reached(config.checkpoint_every, steps):
            self.save()

    def train(self, between: Between | None) -> Gaussians:
        """Run the remaining steps, and write the model and its evaluation. between: function called before each step.

        For a photograph that cannot be read, writes a checkpoint and raises InputError.
        """
        try:
            return self._train(between)
        except InputError as error:
            if self.run is None:
                raise
            if isinstance(error, ScratchError):  # Gaussians read from the scratch file may be wrong: write nothing
                raise InputError(f"{error}{self.last_one}") from None
            raise InputError(f"{error}{self.rescue() or f'; go on with: {self.run.resume_command}'}") from None

    def _train(self, between: Between | None) -> Gaussians:
        trainer, run = self.trainer, self.run
        self.first_step = trainer.step
        _tell_idle_settings(trainer)
        self.tell_plan()
        try:
            self.make_steps(between)
        except (DriverError, CapacityError, TrialInterrupted) as error:  # a checkpoint saves the work so far
            written = self.rescue()
            if written and not isinstance(error, TrialInterrupted):
                raise type(error)(f"{error}{written}") from error
            raise
        trainer.finish()
        space = photos_space(view.path for view in trainer.scene.views)
        if run is not None and trainer.model.in_file:
            rows = trainer.rows()
            run.save_model_rows(rows(0, 1), trainer.parameters.count, rows, space)
            model: Gaussians = GaussiansOfFile(run.model_path, rows(0, 1))
        else:
            model = trainer.gaussians()
            if run is not None:
                run.save_model(model, space)
        if run is not None:
            for component in trainer.components:
                component.write(run)
            if trainer.scene.test_views:
                result = self.evaluate(keep=True)
                run.write_eval(result)
                doubt_poses(result["mean"], trainer.config.refine_gate)
                doubt_length(run.read_metrics(), result["mean"]["psnr"])
                ample = trainer.device.memory.limit is None and not any(trainer.plan.pieces)
                if trainer.config.report and ample:
                    with suppress(
                        CapacityError, DriverError
                    ):  # the training counts as successful even if a picture cannot be rendered
                        views = trainer.cameras.lenses.of_views(trainer.scene.test_views)
                        keep_depths(self.render, model, views, result["views"], run.depth_path)
        return model

    def make_steps(self, between: Between | None) -> None:
        """Run the remaining steps and the work due after them. After Ctrl-C, save and raise Interrupted.

        between: function called before each step.
        """
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
    """Warn if --density.max-gaussians has limited the growth of --density.growth paper, unless training began above
    the limit."""
    density, scene = trainer.config.density, trainer.scene
    given, most = trainer.begins_with.model, GROWTH_LIMIT_FRACTION * density.max_gaussians
    began = (len(scene.points) or trainer.config.random_points) if given is None else len(given)
    if not density.fills and began < most <= trainer.parameters.count:
        warnings.warn(
            f"--density.max-gaussians {density.max_gaussians:,} has limited the growth: --density.growth mcmc, or "
            "budget with --density.long-axis, gives more detail with as many Gaussians"
        )


def doubt_length(metrics: Sequence[Mapping[str, Any]], psnr: float) -> None:
    """Warn if an earlier evaluation of the held-out views was better than the last evaluation, of `psnr` dB.

    metrics: records of metrics.jsonl.
    """
    earlier = [(record["eval"]["mean"]["psnr"], record["step"]) for record in metrics if "eval" in record]
    best, step = max(earlier, default=(psnr, 0))
    if best > psnr + OVERFITTING_DB:
        warnings.warn(
            f"held-out views had {best:.2f} dB after step {step} and have {psnr:.2f} dB at the end: the later steps "
            f"fit the photographs rather than the scene. Train with --iterations {step}, or on more photographs"
        )


def _reached(every: int, steps: range) -> bool:
    """True if one of the steps is a multiple of `every`."""
    return steps[-1] // every > (steps[0] - 1) // every


def _tell_idle_settings(trainer: Trainer) -> None:
    """Warn of each setting that has no effect with this scene."""
    config, count = trainer.config, trainer.parameters.count
    for text in late_settings(config):
        warnings.warn(text)
    if config.eval_at and not trainer.scene.test_views:
        steps = ",".join(map(str, config.eval_at))
        warnings.warn(f"--eval-at {steps}: no view is held out, so that nothing is evaluated; see --test-every")
    if trainer.step == 0 and config.density.every and count > config.density.max_gaussians:
        warnings.warn(
            f"training begins with {count:,} Gaussians, more than --density.max-gaussians "
            f"{config.density.max_gaussians:,}, which limits only their growth"
            + (": give the scene fewer points" if trainer.begins_with.model is None else "")
        )
