# SPDX-License-Identifier: Apache-2.0
"""Functions of the verbs of the command line. Modules that compute are imported when they are needed: --help must be
quick."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clsplat.cli.main import Bench, Demo, Devices, Eval, Render, Selftest, Sfm, Train, Tune, Verb
from clsplat.cli.options import Compare, Convert, Info, Report, View
from clsplat.config.memory import parse_bytes
from clsplat.errors import CapacityError, InputError, plain
from clsplat.process import status_of
from clsplat.rendering.memory_plan import Plan

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from clsplat.camera import Camera
    from clsplat.device.context import Device
    from clsplat.gaussians import Gaussians
    from clsplat.runs.run import Run
    from clsplat.scenes.scene import Scene
    from clsplat.training.loop import Between


_WHERE: dict[type, tuple[str, str]] = {
    Devices: ("verbs", "devices"),
    Demo: ("verbs", "demo"),
    Sfm: ("verbs", "sfm"),
    Train: ("verbs", "train"),
    Eval: ("verbs", "evaluate"),
    Render: ("render", "render"),
    View: ("view", "view"),
    Report: ("report", "report"),
    Compare: ("report", "compare"),
    Convert: ("convert", "convert"),
    Info: ("convert", "info"),
    Bench: ("verbs", "bench"),
    Tune: ("verbs", "tune"),
    Selftest: ("selftest", "selftest"),
}
"""The module and function of each; a module is loaded when it is called."""


def run(verb: Verb) -> int:
    """Do it; returns the exit status. Raises ClsplatError, OSError, KeyboardInterrupt."""
    module, name = _WHERE[type(verb)]
    status: int = getattr(import_module(f"clsplat.cli.{module}"), name)(verb)
    return status


def devices(verb: Devices) -> int:
    """Print the table of devices."""
    from clsplat.device.context import find_device, list_devices
    from clsplat.device.quirks import no_device

    found = list_devices() if verb.device is None else [find_device(verb.device)]
    if not found:
        raise no_device()
    if verb.json:
        print(json.dumps([asdict(info) for info in found], indent=2))
        return 0
    header = ("", "name", "kind", "units", "memory", "platform", "version", "shape")
    rows = [
        (
            str(info.index),
            info.name,
            info.kind,
            str(info.compute_units),
            f"{info.memory_bytes / 2**30:.1f} GiB",
            info.platform,
            info.version.split("  ")[0],  # PoCL lists its build options after two spaces
            info.shape,
        )
        for info in found
    ]
    widths = [max(len(row[column]) for row in [header, *rows]) for column in range(len(header))]
    for row in [header, *rows]:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    return 0


def demo(verb: Demo) -> int:
    """The whole pipeline on a scene of its own."""
    from clsplat.config.training import TrainConfig
    from clsplat.demo.run import run_demo
    from clsplat.device.context import open_device
    from clsplat.selftest.trust import require

    TrainConfig(iterations=verb.iterations).check()
    require(open_device(verb.device))
    result = run_demo(verb.output, device=verb.device, iterations=verb.iterations)
    if verb.json:
        print(json.dumps(result, indent=2))
    return 0


def sfm(verb: Sfm) -> int:
    """Photos to a COLMAP scene."""
    from clsplat.progress import StageProgress
    from clsplat.scenes.sfm import RECORD, reconstruct

    if not verb.photos.is_dir():
        raise InputError(f"{verb.photos}: no such folder, expected one with photos")
    if verb.threads is not None and verb.threads < 1:
        raise InputError(f"--threads {verb.threads}: expected at least 1")
    reconstruct(
        verb.photos,
        verb.output,
        matching=verb.matching,
        camera_model=verb.camera_model,
        threads=verb.threads,
        seed=verb.seed,
        overwrite=verb.overwrite,
        progress=StageProgress(),
    )
    if verb.json:
        print((verb.output / RECORD).read_text("utf-8").rstrip())
    print(f"scene in {verb.output}; next: clsplat train {verb.output} -o RUN", file=sys.stderr)
    return 0


def train(verb: Train) -> int:
    """Scene to run. Everything that can be wrong with the call is found before the run's folder is touched."""
    from clsplat.runs.locks import locked
    from clsplat.runs.run import check_output, is_run

    with ExitStack() as held:
        if is_run(verb.output):
            held.enter_context(locked(verb.output, "train"))
        check_output(verb.output, resume=verb.resume, overwrite=verb.overwrite)
        if verb.accept_changes and not verb.resume:
            raise InputError("--accept-changes is for --resume, expected both")
        if verb.output.is_dir():
            held.enter_context(locked(verb.output, "train"))
        return _train_checked(verb, held)


def _train_checked(verb: Train, held: ExitStack) -> int:
    """Do the work of `train`; `held` takes the lock of a folder that is new."""
    from clsplat.device.context import open_device
    from clsplat.runs import scene_record
    from clsplat.runs.locks import locked
    from clsplat.runs.run import Run, check_resumed
    from clsplat.selftest.trust import require

    limit = parse_bytes(verb.max_device_mem)
    verb.config.check()
    page: Callable[[Scene], AbstractContextManager[Between]] | None = None
    if verb.view:
        from clsplat.cli.view import training_view

        page = training_view(verb)
    source = verb.scene
    if verb.resume:
        earlier = Run.open(verb.output)
        check_resumed(earlier, verb.config)
        source = source or earlier.scene
    if source is None:
        raise InputError("SCENE is missing, expected the folder of the scene to train on")
    device = open_device(verb.device, limit)
    scene = _load_scene(source, verb.config.resolution, verb.config.test_every)
    _check_scene(scene)
    if verb.resume and (done := max((step for step, _ in earlier.checkpoints()), default=0)) > verb.config.iterations:
        raise InputError(
            f"--iterations {verb.config.iterations}: {verb.output} is at step {done} already, expected more"
        )
    if len(scene.points) == 1:  # a Gaussian's size follows from its neighbours, and it has none
        print(
            f"clsplat: warning: {source}: has a single point, training starts from one Gaussian of next to no size",
            file=sys.stderr,
        )
    changed = verb.resume and scene_record.check(
        earlier, scene, source, verb.config.resolution, accept=verb.accept_changes
    )
    device = require(device)
    verb.output.mkdir(parents=True, exist_ok=True)
    held.enter_context(locked(verb.output, "train"))
    run = Run.create(verb.output, verb.config, scene=source, resume=verb.resume, overwrite=verb.overwrite)
    if changed:
        scene_record.write(run, scene)
    print(
        f"{scene.name}: {len(scene.train_views)} pictures to train on, {len(scene.test_views)} held out, "
        f"{len(scene.points):,} points; on {device.name}, {device.driver.split('  ')[0].strip()} (the first steps may "
        "wait for kernels to be built)",
        file=sys.stderr,
    )
    if scene.test_views:
        _tell_of_lpips()
    try:
        with page(scene) if page else nullcontext() as between:
            _train_verb(scene, run, device, between)
    except KeyboardInterrupt as error:
        steps = run.checkpoints()
        at = f"at step {steps[-1][0]}" if steps else "before the first checkpoint"
        with suppress(OSError):  # the terminal may be gone
            print(f"clsplat: interrupted {at}; go on with: clsplat train -o {run.path} --resume", file=sys.stderr)
        return status_of(error)
    result = json.loads(run.eval_path.read_text("utf-8")) if run.eval_path.exists() else None
    if verb.json:
        print(json.dumps(result, indent=2))
    elif result is not None:
        _print_summary(result)
    print(f"model in {run.model_path}", file=sys.stderr)
    return 0


def _train_verb(scene: Scene, run: Run, device: Device, between: Between | None = None) -> Gaussians:
    """The one place that calls the trainer."""
    from clsplat.api import train as run_training
    from clsplat.progress import TrainProgress

    def tell(plan: Plan) -> None:
        if device.memory.limit is not None or any(plan.pieces):
            print(f"{plan.gaussians:,} Gaussians: {plan}", file=sys.stderr)

    with TrainProgress(run.config.iterations) as progress:
        return run_training(
            scene,
            run.config,
            device=device,
            run=run,
            resume=run.resuming,
            on_step=progress,
            on_plan=tell,
            between=between,
        )


def evaluate(verb: Eval, *, held: bool = False) -> int:
    """Model and scene to numbers. held: a run's folder is locked."""
    from clsplat import report
    from clsplat.config.training import TrainConfig
    from clsplat.device.context import open_device
    from clsplat.evaluation.held_out import evaluate as measure
    from clsplat.gaussians import Gaussians
    from clsplat.images.alpha import background_colour
    from clsplat.images.colour import recorded_space
    from clsplat.rendering.renderer import Renderer
    from clsplat.report import last
    from clsplat.runs import scene_record
    from clsplat.runs.locks import locked
    from clsplat.runs.run import Run, is_run, model_file
    from clsplat.scenes import doubts
    from clsplat.selftest.result import FORWARD
    from clsplat.selftest.trust import require

    if is_run(verb.model) and not held:
        with locked(verb.model, "eval"):
            return evaluate(verb, held=True)
    limit = parse_bytes(verb.max_device_mem)
    file = model_file(verb.model)
    given_run = Run.open(verb.model) if is_run(verb.model) else None
    trained = given_run or (Run.open(verb.model.parent) if is_run(verb.model.parent) else None)
    gaussians = Gaussians.load(file)
    config = trained.config if trained else TrainConfig()
    source = verb.scene or (trained.scene if trained else None)
    if source is None:
        raise InputError(f"{verb.model}: the scene it was trained on is not known, expected --scene SCENE")
    resolution = config.resolution if verb.resolution is None else verb.resolution
    test_every = config.test_every if verb.test_every is None else verb.test_every
    device = open_device(verb.device, limit)
    scene = _load_scene(source, resolution, test_every)
    views = [view for view in scene.views if view.split == "test"]
    if not views:
        raise InputError(f"{source}: no view is held out with --test-every {test_every}")
    device = require(device, FORWARD)
    _tell_of_lpips()
    renderer = Renderer(device, config=config.rasterizer)

    background = background_colour(verb.background or config.background)
    told = scene_record.of_evaluation(trained, views) if trained else []
    with suppress(CapacityError):

        def draw(camera: Camera) -> tuple[NDArray[Any], NDArray[Any]]:
            drawn = renderer.render(gaussians, camera, background)
            return drawn.image, drawn.alpha

        told.append(doubts.of_pictures(draw, views, "held-out"))
    for text in filter(None, told):
        print(f"clsplat: warning: {plain(text)}", file=sys.stderr)
    trained_for = given_run.model_record() if given_run else {}
    result = measure(
        lambda view: renderer.render(gaussians, view.camera, background).image,
        views,
        background,
        given_run.test_path if given_run else None,
        step=trained_for.get("step"),
        gaussians=len(gaussians),
        seconds=trained_for.get("seconds"),
        space=recorded_space(file),
    )
    if given_run:
        given_run.write_eval(result)
        if (given_run.path / report.NAME).exists():
            last.write_last(given_run, scene, gaussians)
    if verb.json:
        print(json.dumps(result, indent=2))
        return 0
    for view in result["views"]:
        print(f"{view['name']}  {_scores(view)}")
    _print_summary(result)
    return 0


def bench(verb: Bench) -> int:
    """Measure. What can be wrong with the call is found before anything is."""
    from clsplat.bench import settings as tradeoff
    from clsplat.bench import stages as bench_stages
    from clsplat.bench import subject as bench_subject
    from clsplat.bench.plots import check_plot, plot_files, plot_settings
    from clsplat.device.context import Device, select
    from clsplat.files import check_new
    from clsplat.progress import StageProgress
    from clsplat.selftest.trust import require

    size, limit = parse_size(verb.size), parse_bytes(verb.max_device_mem)
    if verb.gaussians < 1:
        raise InputError(f"--gaussians {verb.gaussians}: expected at least 1")
    if verb.repeat < 1:
        raise InputError(f"--repeat {verb.repeat}: expected at least 1")
    verb.rasterizer.check()
    if verb.plot is not None:
        check_plot(verb.plot)
        for file in plot_files(verb.plot):
            check_new(file, overwrite=verb.overwrite)
    if verb.source is not None and not verb.source.exists():
        raise InputError(f"{verb.source}: no such file or folder, expected a scene, a run or a model file")
    progress = StageProgress()
    device = require(Device(select(verb.device), profile=True))
    device.memory.limit = limit
    most = int(device.cl_device.global_mem_size) // bench_stages.GAUSSIAN_BYTES
    if verb.source is None and verb.gaussians > most:
        raise InputError(f"--gaussians {verb.gaussians}: expected at most {most}, which fill {device.name}'s memory")
    if verb.source is None:
        subject = bench_subject.synthetic(verb.gaussians, *(size or (1024, 768)))
    else:
        subject = bench_subject.load_subject(verb.source, size, progress)
    result = bench_stages.bench(subject, device, verb.rasterizer, repeat=verb.repeat, progress=progress)
    if verb.plot is not None:
        result["settings"] = tradeoff.compare(subject, device, repeat=verb.repeat, progress=progress)
        size_text = f"{result['width']}x{result['height']}, {result['gaussians']:,} Gaussians"
        title = f"{subject.name}, {size_text}\n{device.name}, {device.driver.split('  ')[0]}"
        for file in plot_settings(verb.plot, result["settings"], title):
            print(f"plot in {file}", file=sys.stderr)
    if verb.json:
        print(json.dumps(result, indent=2))
        return 0
    print(bench_stages.table(result))
    if "settings" in result:
        print("\n" + tradeoff.settings_table(result["settings"]))
    return 0


def parse_size(text: str | None) -> tuple[int, int] | None:
    """(width, height) of WIDTHxHEIGHT. Raises InputError."""
    if text is None:
        return None
    words = text.split("x")
    if len(words) != 2 or not all(word.isdecimal() and int(word) > 0 for word in words):
        raise InputError(f"--size {text}: expected a width and a height in pixels such as 1024x768")
    return int(words[0]), int(words[1])


def _check_scene(scene: Scene) -> None:
    """Raise InputError for a scene that would end a training later on: no views to train on, a view too small to
    measure, a picture that is cut."""
    from clsplat.evaluation.metrics import SSIM_WINDOW

    scene.require_training_views()
    for view in scene.test_views:
        if min(view.camera.width, view.camera.height) < SSIM_WINDOW:
            raise InputError(
                f"{view.path}: is {view.camera.width} x {view.camera.height} at this --resolution, expected at least "
                f"{SSIM_WINDOW} pixels a side to measure SSIM"
            )
    scene.check_pictures()


def _tell_of_lpips() -> None:
    """Say once, before the work, that there will be no LPIPS, and why."""
    from clsplat.evaluation.metrics import prepare_lpips

    if reason := prepare_lpips():
        print(f"no LPIPS: {reason}", file=sys.stderr)


def _load_scene(path: Path, resolution: int, test_every: int) -> Scene:
    """The scene, its warnings printed."""
    from clsplat.progress import StageProgress
    from clsplat.scenes.scene import load_scene

    scene = load_scene(path, resolution=resolution, test_every=test_every, progress=StageProgress())
    for warning in scene.warnings:
        print(f"clsplat: warning: {warning}", file=sys.stderr)
    return scene


def _scores(record: dict[str, Any]) -> str:
    names = {"psnr": "PSNR {:.2f} dB", "ssim": "SSIM {:.4f}", "lpips": "LPIPS {:.4f}"}
    return "  ".join(text.format(record[key]) for key, text in names.items() if key in record)


def _print_summary(result: dict[str, Any]) -> None:
    if result["views"]:
        print(f"{len(result['views'])} held-out views  {_scores(result['mean'])}  {result['gaussians']:,} Gaussians")


def tune(verb: Tune) -> int:
    """Print what each shape of the kernels takes, and keep the quickest."""
    from clsplat.bench.shapes import tune as try_shapes
    from clsplat.device.context import all_devices, find_device
    from clsplat.device.shapes import default_shape, save_shape, saved_path

    info = find_device(verb.device)
    device = all_devices()[info.index]
    if verb.forget:
        save_shape(device, None)
        print(f"{info.name} ({info.version.split('  ')[0]}): the default, {default_shape(device)}", file=sys.stderr)
        return 0
    trials, best = try_shapes(
        device, info.index, lambda shape: print(f"trying {shape.lanes} lanes x {shape.items} items", file=sys.stderr)
    )
    if verb.json:
        found = [{"lanes": trial.shape.lanes, "items": trial.shape.items, "ms": trial.ms} for trial in trials]
        print(
            json.dumps({"device": info.name, "version": info.version, "best": asdict(best), "trials": found}, indent=2)
        )
        return 0
    for trial in trials:
        text = "failed" if trial.ms is None else f"{trial.ms:8.2f} ms"
        mark = "  <- kept" if trial.shape == best else ""
        print(f"{trial.shape.lanes:2d} lanes x {trial.shape.items:3d} items  {text}{mark}")
    print(f"in {saved_path()}", file=sys.stderr)
    return 0
