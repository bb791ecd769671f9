# SPDX-License-Identifier: Apache-2.0
"""`clsplat eval`: a model measured on held-out views."""

from __future__ import annotations

import json
import sys
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from clsplat.cli.options import DeviceOptions, Flag, OptionalInt, RunOrModel, ScenePath, Verb
from clsplat.cli.session import Services, load_scene
from clsplat.config.training import Missing, TrainConfig
from clsplat.errors import CapacityError, InputError, warn

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from clsplat.camera import Camera


@dataclass(frozen=True)
class Eval(Verb):
    """Measure a model on a scene's held-out views: PSNR, SSIM, and LPIPS where the extra is installed.

    Given a run, eval.json and test/ are written anew.
    """

    model: RunOrModel
    """A run's folder or a model file; for a file in a run's folder that run's settings hold."""
    scene: ScenePath = None
    """Folder with the scene; the one the run was trained on if not given."""
    test_every: OptionalInt = None
    """Every n-th view by name is held out, and measured. If not given: the run's setting, else 8."""
    resolution: OptionalInt = None
    """Longest image side in pixels; 0 keeps the images' size up to 1600. If not given: the run's setting, else 0."""
    missing: Annotated[Missing | None, arg(metavar="few|skip|error")] = None
    """Pictures that the scene lists and that are not there, as of train. If not given: the run's setting, else few."""
    background: Annotated[Literal["black", "white"] | None, arg(metavar="black|white")] = None
    """Background behind the Gaussians and behind images with alpha. If not given: the run's setting, else black."""
    corrected: Flag = False
    """Tell PSNR of the affine map of colours that fits each photograph best, too; of a run with --appearance it always
    is told."""
    device: Annotated[DeviceOptions, arg(name="")] = field(default_factory=DeviceOptions)
    json: Flag = False
    """Print the result as JSON, as in eval.json."""


def run(verb: Eval, services: Services) -> int:
    """Measure. A run's folder is locked."""
    from clsplat.runs.locks import locked
    from clsplat.runs.run import is_run

    with locked(verb.model, "eval") if is_run(verb.model) else nullcontext():
        return _evaluate(verb, services)


def _evaluate(verb: Eval, services: Services) -> int:
    from clsplat.evaluation.depths import keep_depths
    from clsplat.evaluation.held_out import evaluate
    from clsplat.gaussians import Gaussians
    from clsplat.images.alpha import background_colour
    from clsplat.models.formats import colour_space
    from clsplat.report import NAME
    from clsplat.report.page import write_last
    from clsplat.runs import scene_record
    from clsplat.runs.appearance import looks_of_run
    from clsplat.runs.refined import through_refined
    from clsplat.runs.run import model_file, run_of
    from clsplat.scenes import doubts
    from clsplat.selftest.result import FORWARD

    verb.device.check()
    file = model_file(verb.model)
    trained = run_of(verb.model)
    given_run = trained if trained and trained.path == verb.model else None
    gaussians = Gaussians.load(file)
    config = trained.config if trained else TrainConfig()
    source = verb.scene or (trained.scene if trained else None)
    if source is None:
        raise InputError(f"{verb.model}: the scene it was trained on is not known, expected --scene SCENE")
    resolution = config.resolution if verb.resolution is None else verb.resolution
    test_every = config.test_every if verb.test_every is None else verb.test_every
    device = verb.device.open(services)
    missing = verb.missing or config.missing
    scene = load_scene(services, source, resolution, test_every, config.mask_use, config.lenses, missing)
    views = through_refined([view for view in scene.views if view.split == "test"], trained)
    if not views:
        raise InputError(f"{source}: no view is held out with --test-every {test_every}")
    device = services.require(device, FORWARD)
    tell_of_lpips()
    renderer = services.renderer(device, config=config.rasterizer)
    background = background_colour(verb.background or config.background)

    def draw(camera: Camera) -> tuple[NDArray[Any], NDArray[Any]]:
        result = renderer.render(gaussians, camera, background)
        return result.image, result.alpha

    def render(model: Gaussians, camera: Camera) -> tuple[NDArray[Any], NDArray[Any]]:
        result = renderer.render(model, camera)
        return result.image, result.alpha

    warnings = scene_record.of_evaluation(trained, views) if trained else []
    with suppress(CapacityError):
        warnings.append(doubts.of_pictures(draw, views, "held-out"))
    for text in filter(None, warnings):
        warn(text)
    seen = looks_of_run(trained)
    model_record = given_run.model_record() if given_run else {}
    result = evaluate(
        lambda view: seen(view.name, draw(view.camera)[0]),
        views,
        background,
        given_run.test_path if given_run else None,
        step=model_record.get("step"),
        gaussians=len(gaussians),
        seconds=model_record.get("seconds"),
        space=colour_space(file),
        corrected=verb.corrected or config.appearance != "none",
    )
    if given_run:
        given_run.write_eval(result)
        if (given_run.path / NAME).exists():
            with suppress(CapacityError):
                keep_depths(render, gaussians, views, result["views"], given_run.depth_path)
            write_last(given_run, scene, gaussians)
    if verb.json:
        print(json.dumps(result, indent=2))
        return 0
    for record in result["views"]:
        print(f"{record['name']}  {_scores(record)}")
    print_summary(result)
    return 0


def tell_of_lpips() -> None:
    """Print, before the work, why there will be no LPIPS, if so."""
    from clsplat.evaluation.metrics import prepare_lpips

    if reason := prepare_lpips():
        print(f"no LPIPS: {reason}", file=sys.stderr)


def print_summary(result: dict[str, Any]) -> None:
    """Print the mean scores of eval.json, where there are any."""
    if result["views"]:
        print(f"{len(result['views'])} held-out views  {_scores(result['mean'])}  {result['gaussians']:,} Gaussians")


def _scores(record: dict[str, Any]) -> str:
    names = {
        "psnr": "PSNR {:.2f} dB",
        "psnr_corrected": "colour-corrected {:.2f} dB",
        "psnr_aligned": "aligned {:.2f} dB",
        "ssim": "SSIM {:.4f}",
        "lpips": "LPIPS {:.4f}",
    }
    return "  ".join(text.format(record[key]) for key, text in names.items() if key in record)
