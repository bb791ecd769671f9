# SPDX-License-Identifier: Apache-2.0
"""`clsplat eval`: evaluation of a model on held-out views."""

from __future__ import annotations

import json
import sys
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from clsplat.cli.options import DeviceOptions, Flag, OptionalInt, RunOrModel, ScenePath, Verb
from clsplat.cli.session import Services, load_scene
from clsplat.config.orientation import AS_IN_FILES
from clsplat.config.training import Missing, TrainConfig
from clsplat.errors import CapacityError, InputError, warn

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from clsplat.camera import Camera
    from clsplat.evaluation.held_out import Evaluation
    from clsplat.runs.run import Run
    from clsplat.scenes.scene import Scene, View


@dataclass(frozen=True)
class EvalVerb(Verb):
    """Measure a model on a scene's held-out views: PSNR, SSIM, and LPIPS if the extra is installed.

    For a run, the files eval.json and test/ are replaced.
    """

    model: RunOrModel
    """A run's folder or a model file. For a file in a run's folder, that run's settings apply."""
    scene: ScenePath = None
    """Folder with the scene. If not given: the scene on which the run was trained."""
    test_every: OptionalInt = None
    """Every n-th view in the order of names is held out and measured. If not given: the run's setting, else 8."""
    test_most: OptionalInt = None
    """Maximum number of views that --test-every holds out, spread evenly; 0 for no maximum. If not given: the run's
    setting, else 200."""
    resolution: OptionalInt = None
    """Longest image side in pixels; 0 keeps the images' size up to 1600. If not given: the run's setting, else 0."""
    missing: Annotated[Missing | None, arg(metavar="few|skip|error")] = None
    """Handling of pictures that the scene lists but that are missing. few: at most a tenth may be missing. skip: any
    number. error: none. If not given: the run's setting, else few."""
    background: Annotated[Literal["black", "white"] | None, arg(metavar="black|white")] = None
    """Background behind the Gaussians and behind images with alpha. If not given: the run's setting, else black."""
    corrected: Flag = False
    """Also report PSNR after the affine colour map that fits each photograph best. For a run with --appearance it is
    always reported."""
    device: Annotated[DeviceOptions, arg(name="")] = field(default_factory=DeviceOptions)
    json: Flag = False
    """Print the result as JSON, as in eval.json."""


def run(verb: EvalVerb, services: Services) -> int:
    """Evaluate the model. A run's folder is locked meanwhile."""
    from clsplat.runs.locks import locked
    from clsplat.runs.run import is_run

    with locked(verb.model, "eval") if is_run(verb.model) else nullcontext():
        return _evaluate(verb, services)


def _evaluate(verb: EvalVerb, services: Services) -> int:
    from clsplat.evaluation.depths import keep_depths
    from clsplat.evaluation.held_out import EvaluatedModel, evaluate
    from clsplat.gaussians import Gaussians
    from clsplat.images.alpha import background_colour
    from clsplat.models.formats import colour_space
    from clsplat.report import REPORT_FILE_NAME
    from clsplat.report.page import write_last
    from clsplat.runs.appearance import looks_of_run
    from clsplat.runs.run import model_file, run_of
    from clsplat.selftest.result import FORWARD_STAGES

    verb.device.check()
    file = model_file(verb.model)
    trained = run_of(verb.model)
    given_run = trained if trained and trained.path == verb.model else None
    gaussians = Gaussians.load(file)
    config = trained.config if trained else TrainConfig()
    source = verb.scene or (trained.scene if trained else None)
    if source is None:
        raise InputError(f"{verb.model}: the scene on which it was trained is unknown, expected --scene SCENE")
    device = verb.device.open(services)
    scene, views = _held_out(verb, services, source, trained)
    device = services.require(device, FORWARD_STAGES)
    tell_of_lpips()
    renderer = services.renderer(device, config=config.rasterizer)
    background = background_colour(verb.background or config.background)

    def draw(camera: Camera) -> tuple[NDArray[Any], NDArray[Any]]:
        result = renderer.render(gaussians, camera, background)
        return result.image, result.alpha

    def render(model: Gaussians, camera: Camera) -> tuple[NDArray[Any], NDArray[Any]]:
        result = renderer.render(model, camera)
        return result.image, result.alpha

    _warn_of_doubts(trained, draw, views)
    seen = looks_of_run(trained)
    model_record = given_run.model_record() if given_run else {}
    result = evaluate(
        lambda view: seen(view.name, draw(view.camera)[0]),
        views,
        background,
        given_run.test_path if given_run else None,
        model=EvaluatedModel(model_record.get("step"), len(gaussians), model_record.get("seconds")),
        space=colour_space(file),
        corrected=verb.corrected or config.appearance != "none",
    )
    if given_run:
        given_run.write_eval(result)
        if (given_run.path / REPORT_FILE_NAME).exists():
            with suppress(CapacityError):
                keep_depths(render, gaussians, views, result["views"], given_run.depth_path)
            write_last(given_run, scene, gaussians)
    _print_result(result, as_json=verb.json)
    return 0


def _held_out(verb: EvalVerb, services: Services, source: Path, trained: Run | None) -> tuple[Scene, list[View]]:
    """Return the loaded scene, and its held-out views with the lenses that the run refined. Raises InputError.

    Flags override the run's settings.

    source: the scene's folder.
    trained: the run of the model; None for a model without a run.
    """
    from clsplat.runs.refined_lenses import through_refined

    config = trained.config if trained else TrainConfig()
    flags = {name: getattr(verb, name) for name in ("resolution", "test_every", "test_most", "missing")}
    config = replace(config, **{name: value for name, value in flags.items() if value is not None})
    frame = AS_IN_FILES if trained is None else trained.frame_for(source)
    scene = load_scene(services, source, config, frame=frame)
    views = through_refined([view for view in scene.views if view.split == "test"], trained)
    if not views:
        raise InputError(f"{source}: no view is held out with --test-every {config.test_every}, expected at least one")
    return scene, views


def _warn_of_doubts(
    trained: Run | None, draw: Callable[[Camera], tuple[NDArray[Any], NDArray[Any]]], views: list[View]
) -> None:
    """Warn of views that the run was trained on, changed views, views of another scene, and renders without content.

    trained: the run of the model; None for a model without a run.
    draw: function that renders a camera to (image, alpha).
    """
    from clsplat.runs import scene_record
    from clsplat.scenes.analysis import sanity_checks

    warnings = scene_record.of_evaluation(trained, views) if trained else []
    with suppress(CapacityError):
        warnings.append(sanity_checks.of_pictures(draw, views, "held-out"))
    for text in filter(None, warnings):
        warn(text)


def _print_result(result: Evaluation, *, as_json: bool) -> None:
    if as_json:
        print(json.dumps(result, indent=2))
        return
    for record in result["views"]:
        print(f"{record['name']}  {_scores(record)}")
    print_summary(result)


def tell_of_lpips() -> None:
    """Print the reason if LPIPS cannot be measured. Call this before training or rendering begins."""
    from clsplat.evaluation.metrics import prepare_lpips

    if reason := prepare_lpips():
        print(f"no LPIPS: {reason}", file=sys.stderr)


def print_summary(result: Evaluation) -> None:
    """Print the mean scores of an evaluation, if any view was measured."""
    if result["views"]:
        print(f"{len(result['views'])} held-out views  {_scores(result['mean'])}  {result['gaussians']:,} Gaussians")


def _scores(record: Mapping[str, object]) -> str:
    names = {
        "psnr": "PSNR {:.2f} dB",
        "psnr_corrected": "colour-corrected {:.2f} dB",
        "psnr_aligned": "aligned {:.2f} dB",
        "ssim": "SSIM {:.4f}",
        "lpips": "LPIPS {:.4f}",
    }
    return "  ".join(text.format(record[key]) for key, text in names.items() if key in record)
