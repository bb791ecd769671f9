# SPDX-License-Identifier: Apache-2.0
"""The experiments of docs/quality.md: the scenes, disturbances and settings of each, and the rows of its tables."""

from __future__ import annotations

import hashlib
from argparse import Namespace
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from quality.blocks import blocks
from quality.border_colours import border_colours
from quality.camera_choices import cameras as sfm_cameras
from quality.made_scenes import (
    Changes,
    baked,
    changed,
    demo,
    disturbed,
    fisheye_of,
    in_units,
    photograph,
    picked,
    refocused,
    rgbd,
    turntable,
    with_block,
    without_colours,
    write_colmap,
    write_strip,
    write_transforms,
)
from quality.survey_formats import survey_formats
from quality.towns import towns
from quality.trainings import Rows, picture_of, psnr_of, trained
from quality.view_orders import orders

from clsplat.camera import Camera
from clsplat.config.cli_defaults import TEST_EVERY
from clsplat.config.training import TrainConfig
from clsplat.demo.ray_caster import cameras
from clsplat.device.selection import open_device
from clsplat.evaluation import metrics
from clsplat.images.alpha import Image, background_colour, composite
from clsplat.rendering.renderer import Renderer
from clsplat.runs.appearance import held_out_looks
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene, View
from clsplat.training.held_out_alignment import aligned
from clsplat.training.trainer import Trainer

POINTS = {"scene": (1000, 40_000), "turntable": (1000, 20_000), "poses": (5000, 5000)}
"""Numbers of sparse and dense points in synthetic scenes. Structure from motion finds about the sparse number."""
PHOTOS = 40
"""Number of photographs of a synthetic scene, and of an RGB-D sequence."""
WIDTH = 120
"""Width of these photographs in pixels."""
LEAST = 2500
"""Number of steps of trainings from dense points or known depths."""
STEPS = (250, 500, 1000, 1500, 2000, 2500, 5000)
"""Steps at which held-out pictures are measured in between."""
OFF_DEGREES, OFF_PERCENT = 0.5, 1.0
"""Disturbance of poses, in degrees and percent of the extent."""
EXPOSED = (
    ("clean", False, False),
    ("gains", True, False),
    ("clean, learnt", False, True),
    ("gains, learnt", True, True),
)
"""Rows of the exposure experiment: name, True if gains change the photographs, True if appearance is learnt."""
UNITS = (*((factor, 0.0) for factor in (1.0, 1e-7, 1e-4, 1e4, 1e7)), (1.0, 1e6))
"""Factors by which a scene's world is scaled, and distances by which it is moved."""


def masks(given: Namespace) -> Rows:
    """Photographs with a moving block, with and without masks, and a cut-out object on a turntable.

    A block of patterned pixels covers a twelfth of each training photograph of a COLMAP scene, in another place each
    time, and masks cover the block. The exit status is 1 if a model trained with masks depends on the block's pixels.
    The held-out photographs have no block. The turntable is the demo's still life without floor and wall: photographs
    with alpha, trained over black. The column alpha is the render's alpha where held-out photographs are transparent.
    block.png and turntable.png show photographs and renders side by side.
    """
    path, renderer = given.scenes[0].resolve(), Renderer(open_device())
    blocks = [with_block(path, given.folder / f"{path.name}-block-{seed}", seed) for seed in (1, 2)]
    yield path.name, "PSNR, dB", "SSIM", "Gaussians", "digest of the model"
    view = load_scene(blocks[0], resolution=given.resolution).train_views[0]
    pictures, digests = [view.load()[:, :, :3]], []
    for name, scene, *words in (
        ("photographs as they were", path),
        ("with the block", blocks[0]),
        ("with the block, `--masks ignore`", blocks[0], "--masks", "ignore"),
        ("with other pixels, `--masks ignore`", blocks[1], "--masks", "ignore"),
    ):
        row = trained(given, name.replace("`", ""), scene, *words)
        mean, model = row.last["mean"], row.model
        digests.append(hashlib.blake2b((row.run / "model.ply").read_bytes(), digest_size=8).hexdigest())
        yield name, f"{mean['psnr']:.2f}", f"{mean['ssim']:.4f}", f"{len(model):,}", digests[-1]
        pictures.append(renderer.render(model, view.camera).image[:, :, :3])
    write_strip(given.folder / "block.png", pictures)
    same = digests[2] == digests[3]
    yield f"Pixels under the masks change {'no bit' if same else 'the bits'} of the model."
    scene = given.folder / f"turntable-{given.seed}"
    write_transforms(scene, turntable(PHOTOS, given.seed), POINTS["turntable"], given.seed)
    strips = []
    yield "turntable", "alpha outside", "PSNR over white, dB", "Gaussians"
    for meaning in ("blend", "transparent"):
        model = trained(given, f"turntable {meaning}", scene, "--alpha", meaning, resolution=None).model
        outside, scores, pictures = [], [], []
        for view in load_scene(scene).test_views:
            truth, seen = view.load(), renderer.render(model, view.camera, background=(1, 1, 1))
            outside.append(seen.alpha[truth[:, :, 3] == 0])
            white = composite(truth, (1, 1, 1))
            scores.append(metrics.psnr(seen.image[:, :, :3], white))
            pictures.append(np.concatenate([white, seen.image[:, :, :3]]))
        strips.append(pictures[0])
        alpha = np.concatenate(outside).mean()
        yield f"`--alpha {meaning}`", f"{alpha:.4f}", f"{np.mean(scores):.2f}", f"{len(model):,}"
    write_strip(given.folder / "turntable.png", strips)
    return int(not same)


def exposure(given: Namespace) -> Rows:
    """Photographs with changing exposure against the original photographs, with and without --appearance.

    The photographs are written at the training resolution as float EXR, once unchanged and once multiplied by 2^U(-1,
    1), so that nothing clips. --mixes also mixes their channels, by up to its fraction, and --corners adds a lens that
    transmits 2^-CORNERS of the light in the corners. All models are compared with the unchanged held-out photographs,
    directly and after the affine map of colours that fits best. The table has the largest and mean error of the learnt
    gains up to a common factor. A second pair of errors is relative to the gains learnt from the unchanged photographs,
    whose exposure may vary too. For --appearance ppisp there are also the rms errors of mixes, without their mean and
    relative to those of the unchanged photographs, and the errors of the light in the corners.
    """
    clean = load_scene(given.scenes[0], resolution=given.resolution)
    renderer, rng = Renderer(open_device()), np.random.default_rng(given.seed)
    gains = 2.0 ** rng.uniform(-1, 1, len(clean.views))
    changes = Changes(gains, given.mixes * rng.uniform(-1, 1, (len(clean.views), 6)), given.corners)
    put_on = {view.name: [np.log2(gain)] for view, gain in zip(clean.views, gains, strict=True)}
    mixes = {view.name: mix for view, mix in zip(clean.views, changes.mixes, strict=True)}
    yield "photographs", "PSNR", "corrected", "Gaussians", "seconds", "gains wrong by", "and but for those of clean"
    own: dict[str, dict[str, list[float]]] = {}
    for name, put, learns in EXPOSED:
        kind = f"gains{changes.label}" if put else "clean"
        folder = given.folder / f"{kind}-{given.resolution}-{given.seed}"
        scene = replace(changed(clean, folder, changes if put else changes.none), name=f"{clean.name} {kind}")
        row = trained(given, name, scene, "--appearance", given.appearance if learns else "none")
        model, last, scores, cells = row.model, row.last, [], ["", ""]
        for view in clean.test_views:
            truth, image = composite(view.load(), (0, 0, 0)), renderer.render(model, view.camera).image[:, :, :3]
            scores.append((metrics.psnr(image, truth), metrics.psnr_corrected(image, truth)))
        psnr, corrected = np.mean(scores, axis=0)
        if put and learns:
            logs, of_clean = _gains(row.appearance), _gains(own)
            also = {name: np.add(of_clean[name], put_on[name]).tolist() for name in of_clean}
            cells = [gain_errors(logs, wanted) for wanted in (put_on, also)]
        yield name, f"{psnr:.2f}", f"{corrected:.2f}", f"{len(model):,}", f"{last['seconds']:.0f}", *cells
        if learns and any("mixes" in logs for logs in row.appearance.values()):
            yield "", *colour_errors(row.appearance, own if put else {}, mixes, given.corners, put=put)
        own = row.appearance if learns else own
    return 0


def _gains(photographs: Mapping[str, Mapping[str, list[float]]]) -> dict[str, list[float]]:
    return {name: logs.get("log2_gains") or logs["log2_exposure"] for name, logs in photographs.items()}


def gain_errors(learnt: Mapping[str, list[float]], wanted: Mapping[str, list[float]]) -> str:
    """Largest and mean relative error of the learnt gains, up to a common factor.

    learnt, wanted: base-2 logarithms of gains, keyed by photograph.
    """
    apart = np.array([np.subtract(learnt[name], wanted[name]) for name in learnt])
    wrong = np.abs(2.0 ** (apart - apart.mean(axis=0)) - 1)
    return f"{wrong.max():.1%} / {wrong.mean():.1%}"


def colour_errors(
    learnt: Mapping[str, Any], own: Mapping[str, Any], mixes: Mapping[str, Any], corners: float, *, put: bool
) -> tuple[str, ...]:
    """Table cells with the errors of the mixes and of the light in the corners.

    learnt, own: the appearance learnt from the photographs, and from the unchanged photographs; `own` may be empty.
    mixes, corners: the changes of photographs.
    put: True if the photographs were changed.
    """
    apart = np.array([np.subtract(logs["mixes"], mixes[name] * put) for name, logs in learnt.items()])
    if own:
        apart -= np.array([own[name]["mixes"] for name in learnt])
    off = np.sqrt(np.square(apart - apart.mean(axis=0)).mean())
    size = np.sqrt(np.mean([np.square(value * put) for value in mixes.values()]))
    octaves, before = (
        sum(next((logs["vignette"] for logs in each.values() if "vignette" in logs), [])) for each in (learnt, own)
    )
    told = f"corners {octaves - before:+.3f} octaves, put on {-corners * put:+.3f}"
    return f"mixes off by {off:.4f} of {size:.4f}", told, "", "", "", ""


def fisheye(given: Namespace) -> Rows:
    """A fisheye capture of 190 degrees against pinhole photographs of the same scene.

    The demo's ray caster makes both captures from the same places: one with Kannala and Brandt's lens, one with a
    pinhole that has as many pixels per radian on the axis. Masks hide the pixels around the fisheye's circle. Both
    models are measured on the same held-out pinhole pictures, and on the inner and outer half of their pixels. The
    fisheye's model is rendered along rays, as its file says. views.png shows the true picture, both models' renders,
    and the fisheye's own held-out picture.
    """
    surfaces, renderer = baked(given.seed), Renderer(open_device())
    pinholes = cameras(PHOTOS, WIDTH, WIDTH * 3 // 4, given.seed)
    side = round(pinholes[0].fx * 1000 / fisheye_of(pinholes[0], 1000).fx)
    fisheyes = [fisheye_of(camera, side) for camera in pinholes]
    models = {}
    for name, views, use in (("fisheye", fisheyes, "ignore"), ("pinhole", pinholes, "none")):
        scene = write_colmap(given.folder / f"{name}-{given.seed}", surfaces, views)
        models[name] = trained(given, name, scene, "--lenses", "native", "--masks", use).model
    one = pinholes[0]
    away = np.hypot(*np.meshgrid(*(np.abs(np.arange(size) + 0.5 - size / 2) for size in (one.width, one.height))))
    parts = {"whole": away >= 0, "inner half": away <= np.median(away), "outer half": away > np.median(away)}
    scores: dict[tuple[str, str], list[float]] = {(name, part): [] for name in models for part in parts}
    strips = []
    for index in range(0, PHOTOS, TEST_EVERY):
        truth = photograph(surfaces, pinholes[index])
        images = {name: renderer.render(model, pinholes[index]).image for name, model in models.items()}
        for (name, part), values in scores.items():
            values.append(metrics.psnr(images[name][:, :, :3], truth, parts[part]))
        own = renderer.render(models["fisheye"], fisheyes[index]).image[:, :, :3]
        crop = own[(side - truth.shape[0]) // 2 :, (side - truth.shape[1]) // 2 :][: truth.shape[0], : truth.shape[1]]
        whole = own[:: -(-side // truth.shape[0]), :: -(-side // truth.shape[0])]
        shown = np.zeros((truth.shape[0], whole.shape[1], 3), np.float32)
        shown[: whole.shape[0]] = whole
        strips.append(np.concatenate([truth, *images.values(), crop, shown], axis=1))
    write_strip(given.folder / "views.png", strips, axis=0)
    yield "pixels", "fisheye, dB", "pinhole, dB", "lost by the fisheye, dB", "Gaussians"
    counts = ", ".join(f"{len(model):,}" for model in models.values())
    for part in reversed(parts):
        pair = [float(np.mean(scores[name, part])) for name in models]
        yield part, *(f"{value:.2f}" for value in pair), f"{pair[1] - pair[0]:+.2f}", counts
    return 0


def points(given: Namespace) -> Rows:
    """Dense points and known depths against sparse points: how many steps they need for the same PSNR.

    The scene is the demo's, whose ray caster knows every depth, or an RGB-D sequence: a folder of frame-N.color.jpg,
    .depth.png (16 bit, mm) and .pose.txt, with camera-intrinsics.txt. Sparse points are drawn at random from the dense
    points. The trainings start from sparse points with --iterations steps, and with fewer steps from dense points, from
    sparse points with depth maps, and from dense points with depth maps. The table has PSNR by step.
    """
    made = rgbd(given.scenes[0], WIDTH, PHOTOS) if given.scenes else demo(WIDTH, PHOTOS, given.seed)
    name = f"{given.scenes[0].name if given.scenes else 'scene'}-{given.seed}"
    scene = write_transforms(given.folder / name, made, POINTS["scene"], given.seed)
    dense, depth = ("--points", str(scene / "dense.ply")), ("--depth", "maps")
    scores = {}
    for name, most, words in (
        ("sparse", given.iterations, ()),
        ("dense", LEAST, dense),
        ("depth", LEAST, depth),
        ("both", LEAST, (*dense, *depth)),
    ):
        early = ",".join(str(step) for step in STEPS if step < most)
        scores[name] = trained(given, name, scene, *words, iterations=most, eval_at=early).psnr_by_step()
    steps = sorted({step for values in scores.values() for step in values})
    yield "PSNR, dB", *steps
    for name, values in scores.items():
        yield name, *(f"{values[step]:.2f}" if step in values else "" for step in steps)
    wanted = scores.pop("sparse")[given.iterations]
    for name, values in scores.items():
        first = next((step for step, value in sorted(values.items()) if value >= wanted), None)
        yield f"{name}: {wanted:.2f} dB {f'reached by step {first}' if first else 'not reached'}"
    return 0


def colours(given: Namespace) -> Rows:
    """Points without colours against the same points with colours: PSNR by step in COLMAP scenes."""
    early = [step for step in (300, 1000) if step < given.iterations]
    yield "scene", "points", *early, given.iterations
    for path in given.scenes:
        grey = without_colours(path, given.folder / f"{path.name}-grey")
        for kind, scene in (("coloured", path), ("bare", grey)):
            row = trained(given, f"{path.name} {kind}", scene, eval_at=",".join(map(str, early)))
            yield path.name, kind, *(f"{value:.2f}" for value in row.psnr_by_step().values())
    return 0


def poses(given: Namespace) -> Rows:
    """Disturbed poses or lenses, and how well training corrects them (--refine-poses, --refine-lenses).

    The scene is the demo's, whose poses are exact, or another at --width. All training poses except the two fixed ones
    are turned about random axes and shifted. There are three trainings: the original scene, the disturbed scene, and
    the disturbed scene with refined poses. The table has mean errors of the disturbed poses, and PSNR on held-out
    views, with their own poses and with the poses that fit the model best. --lens instead disturbs focal length and
    horizontal principal point by so many hundredths of the focal length; the run can refine them by 2.5 times as much.
    """
    if given.scenes:
        scene = load_scene(given.scenes[0], resolution=given.width)
    else:
        made = demo(given.width, PHOTOS, given.seed)
        folder = given.folder / f"scene-{given.width}-{given.seed}"
        scene = load_scene(write_transforms(folder, made, POINTS["poses"], given.seed))
    plain = TrainConfig(iterations=given.iterations, seed=given.seed)
    if given.lens:
        off = refocused(scene, given.lens / 100)
        refined = replace(plain, refine_lenses=True, lens_reach=2.5 * given.lens)
    else:
        off = disturbed(scene, OFF_DEGREES, OFF_PERCENT, given.seed)
        refined = replace(plain, refine_poses=True)
    true, extent = [view.camera for view in scene.train_views], scene.extent
    yield f"{len(true)} training views, extent {extent:.3g}"
    yield "trained", "degrees", "% of extent", "PSNR own", "PSNR aligned"
    for name, subject, config in (("as it is", scene, plain), ("disturbed", off, plain), ("refined", off, refined)):
        trainer = Trainer(subject, config, open_device())
        while trainer.step < config.iterations:
            trainer.train_step()
        trainer.finish()
        degrees, shift = pose_errors(trainer.cameras.poses.cameras, true)
        both = pose_psnr(trainer, config, subject)
        yield name, f"{degrees:.3f}", f"{100 * shift / extent:.3f}", *(f"{psnr:.2f}" for psnr in both)
        for log, x, y in trainer.cameras.lenses.changes if config.refine_lenses else ():
            moved = f"principal point {x:+.2%} across, {y:+.2%} down"
            yield f"the focal length has changed by {np.expm1(log):+.2%}, the {moved}"
        trainer.close()
    return 0


def pose_psnr(trainer: Trainer, config: TrainConfig, scene: Scene) -> tuple[float, float]:
    """Mean PSNR of the held-out views in dB, with their own poses and with the poses that fit the model best."""
    background, renderer = background_colour(config.background), Renderer(trainer.device, config=config.rasterizer)
    views = trainer.cameras.lenses.of_views(scene.test_views)

    def psnr(camera_of: Callable[[View], Camera]) -> float:
        def draw(view: View) -> Image:
            return renderer.render(trainer.parameters, trainer.local(camera_of(view)), background).image

        return psnr_of(draw, views, background)

    return psnr(lambda view: view.camera), psnr(partial(aligned, trainer, look=held_out_looks(None)))


def pose_errors(learnt: list[Camera], true: list[Camera]) -> tuple[float, float]:
    """Mean error of the disturbed poses, in degrees and world units. Two of the poses stay fixed and do not count."""
    cosines = [(np.trace(a.rotation @ b.rotation.T) - 1) / 2 for a, b in zip(learnt, true, strict=True)]
    shifts = [np.linalg.norm(a.position - b.position) for a, b in zip(learnt, true, strict=True)]
    count = len(true) - 2
    return float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).sum()) / count, float(np.sum(shifts)) / count


def views(given: Namespace) -> Rows:
    """Training on few photographs: PSNR of the held-out views by number of photographs, for several settings.

    The photographs are picked evenly from the training views by name, the same ones each time. The points are those of
    the whole scene. The table has a row for the defaults, and one for each --try.
    """
    methods = {"as ever": "", **dict(one.split(":", 1) for one in given.tried)}
    scene = load_scene(given.scenes[0], resolution=given.resolution)
    yield "settings", *(f"{count} views" for count in given.views)
    for method, settings in methods.items():
        means = []
        for count in given.views:
            train = partial(trained, given, f"{method} {count}", picked(scene, count), settings=settings)
            rows = [train(seed=seed) for seed in given.seeds]
            means.append(np.mean([row.last["mean"]["psnr"] for row in rows]))
        yield method, *(f"{mean:.2f}" for mean in means)
    return 0


def seeds(given: Namespace) -> Rows:
    """Held-out PSNR of scenes trained with several seeds, to compare the code before and after a change."""
    yield "scene", "PSNR, dB", "of the seeds", "Gaussians"
    for path in given.scenes:
        rows = [trained(given, path.name, path, seed=seed).last for seed in given.seeds]
        psnr = [row["mean"]["psnr"] for row in rows]
        gaussians = np.mean([row["gaussians"] for row in rows])
        yield path.name, f"{np.mean(psnr):.3f}", f"{min(psnr):.3f} to {max(psnr):.3f}", f"{gaussians:,.0f}"
    return 0


def units(given: Namespace) -> Rows:
    """A scene in various units, or moved: each is trained in the same way, written, read back and rendered.

    The exit status is 1 if PSNR differs by more than --bound from that in the scene's own units.
    """
    scene, renderer = load_scene(given.scenes[0], resolution=given.resolution), Renderer(open_device())
    yield "times", "moved by", "extent", "near plane", "Gaussians", "PSNR, dB", "beside its own units"
    wanted, off = None, 0
    for factor, offset in UNITS:
        moved = in_units(scene, factor, np.full(3, offset))
        model = trained(given, f"{factor:g} {offset:g}", moved).model
        psnr = psnr_of(partial(picture_of, renderer, model), moved.test_views)
        wanted = psnr if wanted is None else wanted
        off += not abs(psnr - wanted) <= given.bound
        cells = f"{moved.extent:.3g}", f"{getattr(model, 'near', 0.01):.2g}", f"{len(model):,}"
        yield f"{factor:g}", f"{offset:g}", *cells, f"{psnr:.2f}", f"{psnr - wanted:+.3f}"
    return int(off > 0)


def numbers(text: str) -> list[int]:
    """Parse whole numbers separated by commas."""
    return [int(number) for number in text.split(",")]


@dataclass(frozen=True)
class Experiment:
    """An experiment: the function that yields its rows, its number of scenes (as argparse's nargs, 0 for none), its
    default number of steps, and its additional options for argparse."""

    rows: Callable[[Namespace], Rows]
    scenes: int | str
    iterations: int
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


def _number(usual: float, words: str = "") -> dict[str, Any]:
    return {"type": type(usual), "default": usual, "help": words}


def _numbers(usual: list[int]) -> dict[str, Any]:
    return {"type": numbers, "default": usual, "help": "with commas between"}


RESOLUTION = {"--resolution": _number(200, "longest side of the photographs; 0: as they are, up to 1600")}
WITH = {"--with": {"dest": "settings", "default": "", "help": "setting=value,... of `clsplat train`"}}
SEEDS = {"--seeds": _numbers([0])}
TRY = {"--try": {"dest": "tried", "action": "append", "default": [], "help": "NAME:setting=value,..."}}
APPEARANCE = {"--appearance": {"default": "exposure"}, "--mixes": _number(0.0), "--corners": _number(0.0)}
TOWNS = {
    "--towns": {"default": "1x1,3x3,6x6", "help": "with commas between"},
    "--scaled": {"default": "8x1", "help": "the town in metres, millimetres and kilometres"},
    "--town-photos": _number(40, "photographs a block"),
    "--town-size": {"default": "320x200", "help": "size of the photographs"},
    "--gaussians": _number(5000, "Gaussians a block"),
    "--sky": _number(3000, "Gaussians of the sky"),
    "--own-block": {"action": "store_true", "help": "photographs of --towns count where they show their own block"},
    "--passes": _number(30, "passes through the photographs, if --iterations is 0"),
}
BLOCKS = {
    "--town": {"default": "2x2"},
    "--town-photos": _number(40, "photographs a block of the town"),
    "--town-size": {"default": "320x200", "help": "size of the photographs"},
    "--blocks": {"default": "2x2", "help": "as for `clsplat train`"},
    "--gaussians": _number(20_000, "largest number of Gaussians"),
    "--sky": _number(3000, "Gaussians of the sky"),
}
BORDERS = {
    "--exposure": _number(1.0, "stops of the town whose exposure drifts"),
    "--exposed-blocks": {"action": "store_true", "help": "one exposure for each block of the town, instead of a drift"},
}
CAMERAS: dict[str, Any] = {
    "--choices": {"default": "auto", "help": "'matching=exhaustive,mapper=global;auto', with semicolons between"},
    "--threads": {"type": int, "help": "threads of `clsplat sfm`; one per core if not given"},
    "--psnr": {"action": "store_true", "help": "train each scene as well"},
}
EXPERIMENTS = {
    "masks": Experiment(masks, 1, 7000, RESOLUTION),
    "exposure": Experiment(exposure, 1, 2000, {**RESOLUTION, **WITH, **APPEARANCE}),
    "fisheye": Experiment(fisheye, 0, 2000),
    "points": Experiment(points, "?", 7000),
    "colours": Experiment(colours, "+", 2000, {"--resolution": _number(0)}),
    "poses": Experiment(poses, "?", 7000, {"--width": _number(WIDTH, "pixels across"), "--lens": _number(0.0)}),
    "views": Experiment(views, 1, 2000, {**RESOLUTION, **SEEDS, **TRY, "--views": _numbers([3, 6, 9, 12])}),
    "seeds": Experiment(seeds, "+", 2000, {**RESOLUTION, **WITH, **SEEDS}),
    "orders": Experiment(orders, "+", 3000, {**RESOLUTION, **WITH, **SEEDS}),
    "towns": Experiment(towns, 0, 0, {**WITH, **TOWNS}),
    "blocks": Experiment(blocks, 0, 4000, {**RESOLUTION, **WITH, **BLOCKS}),
    "borders": Experiment(border_colours, 0, 4000, {**RESOLUTION, **WITH, **SEEDS, **BLOCKS, **BORDERS}),
    "sfm": Experiment(sfm_cameras, "+", 2000, {**RESOLUTION, **CAMERAS}),
    "formats": Experiment(
        survey_formats, 1, 1000, {**RESOLUTION, **WITH, "--bound": _number(0.05, "largest difference in dB")}
    ),
    "units": Experiment(units, 1, 300, {**RESOLUTION, "--bound": _number(0.3, "dB")}),
}
"""The experiments, keyed by name."""
