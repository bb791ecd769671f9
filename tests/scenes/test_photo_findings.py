# SPDX-License-Identifier: Apache-2.0
"""Findings about scenes that are made to have them, and none about a scene that has nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import Capture, only
from scipy import ndimage
from tiny import HEIGHT, VIEWS, WIDTH, write_scene

from clsplat.camera import Camera
from clsplat.cli.main import main
from clsplat.config.masks import MaskUse
from clsplat.config.presets import bundled, by_passes, scheduled
from clsplat.config.training import DensityConfig, TrainConfig
from clsplat.images.writing import write_image
from clsplat.runs.run import Run
from clsplat.scenes.analysis.photo_findings import FEW_TRAINING_VIEWS, SPARSE_TRAINING_VIEWS, Finding, findings
from clsplat.scenes.analysis.recommendations import (
    ADVICE_BY_FINDING,
    SCHEDULED_SETTINGS,
    SETTINGS_BY_FINDING,
    answered,
    paragraph,
    with_settings,
)
from clsplat.scenes.dataset import Lens
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene, View
from clsplat.scenes.thumbnail import Thumbnail, sharpness_of, thumbnail_of

ACROSS, DOWN = 96, 64
SQUARE = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)
"""Pixels that a point covers, from its own."""


def camera_at(angle: float, distance: float) -> Camera:
    """A camera on a circle about the y axis, y down, that looks at the middle."""
    forward = np.array([-np.sin(angle), 0.0, -np.cos(angle)])
    rotation = np.stack([np.cross([0.0, 1.0, 0.0], forward), [0.0, 1.0, 0.0], forward])
    focal, centre = 0.9 * ACROSS, (ACROSS / 2, DOWN / 2)
    return Camera(ACROSS, DOWN, focal, focal, *centre, rotation, rotation @ forward * distance)


def made(count: int = 32, distances: tuple[float, ...] = (4.0,)) -> Scene:
    """Photographs of a ball of points of many colours, all round it, before a grey wall."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(6000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    colors = rng.uniform(0.2, 0.8, (6000, 3)).astype(np.float32)
    lens = Lens("PINHOLE", ACROSS, DOWN, (0.9 * ACROSS, 0.9 * ACROSS, ACROSS / 2, DOWN / 2))
    cameras = [camera_at(2 * np.pi * index / count, distances[index % len(distances)]) for index in range(count)]
    paths = [Path(f"{index:02d}.png") for index in range(count)]
    views = [View(path.name, camera, path, "train", lens) for path, camera in zip(paths, cameras, strict=True)]
    scene = Scene("made", views, points, colors, (-np.ones(3), np.ones(3)))
    thumbnails = {}
    for index, view in enumerate(scene.sampled_views):  # all, but of a thousand
        camera = view.camera
        local = points @ camera.rotation.T + camera.translation
        places = (local[:, :2] / local[:, 2:] * camera.fx + [camera.cx, camera.cy]).astype(int)
        pixels = rng.uniform(0.45, 0.55, (DOWN, ACROSS, 3)).astype(np.float32)
        order = np.argsort(-local[:, 2])
        x, y = (places[order, None, :] + SQUARE).reshape(-1, 2).T
        inside = (x >= 0) & (x < ACROSS) & (y >= 0) & (y < DOWN)
        pixels[y[inside], x[inside]] = colors[np.repeat(order, len(SQUARE))[inside]]  # of equal places the last counts
        thumbnails[view.name] = Thumbnail(pixels, 0.0, 0.6 + 0.02 * (index % 5))
    scene.__dict__["thumbnails"] = thumbnails
    for name in ("sampled_views", "train_views"):  # views may be changed
        scene.__dict__.pop(name, None)
    return scene


def changed(scene: Scene, index: int, **changes: object) -> None:
    name = scene.views[index].name
    scene.thumbnails[name] = replace(scene.thumbnails[name], **changes)  # type: ignore[arg-type]


def kinds(scene: Scene) -> list[str]:
    return [finding.kind for finding in findings(scene)]


def test_nothing_is_found_where_nothing_is() -> None:
    scene = made()
    assert findings(scene) == []
    answers, config = answered([], TrainConfig())
    assert config == TrainConfig()
    assert paragraph(answers, 24, auto=False) == "inspected 24 photographs: no setting needs to change"


@pytest.mark.parametrize("range_of", [1.0, 0.02])
def test_exposures_that_differ(range_of: float) -> None:
    scene = made()
    gains = 2 ** np.random.default_rng(2).uniform(-range_of, range_of, len(scene.views))
    for index, gain in enumerate(gains):
        pixels = scene.thumbnails[scene.views[index].name].pixels * np.float32(gain)
        changed(scene, index, pixels=np.clip(pixels, 0, 1))
    found = findings(scene)
    assert [finding.kind for finding in found] == (["exposure"] if range_of == 1 else [])
    if found:
        darkest, brightest = scene.views[gains.argmin()].name, scene.views[gains.argmax()].name
        assert f", and {darkest} and {brightest} differ by " in found[0].text
        spread = float(found[0].text.split()[8])
        assert abs(spread - np.log2(gains).std()) < 0.15


def test_a_cast_of_one_channel_is_an_exposure() -> None:
    scene = made()
    for index in range(0, 24, 2):
        pixels = scene.thumbnails[scene.views[index].name].pixels.copy()
        pixels[:, :, 2] *= 0.6
        changed(scene, index, pixels=pixels)
    assert kinds(scene) == ["exposure"]


def test_near_and_far() -> None:
    assert kinds(made(distances=(3.0, 24.0))) == ["scales"]
    assert kinds(made(distances=(3.0, 5.0))) == []


def test_few_views() -> None:
    assert kinds(made(FEW_TRAINING_VIEWS - 1)) == ["few views"]
    assert kinds(made(FEW_TRAINING_VIEWS)) == ["some views"]
    assert kinds(made(SPARSE_TRAINING_VIEWS - 1)) == ["some views"]
    assert kinds(made(SPARSE_TRAINING_VIEWS)) == []


@pytest.mark.parametrize(
    ("points", "size", "most"),
    [
        (4000, (192, 128), 9216),  # a Gaussian for 64 pixels: 24 of 192 x 128
        (600, (960, 640), 7200),  # 12 a point
        (6000, (32, 24), 9000),  # three for two points, whatever the pixels
        (0, (960, 640), 230_400),
    ],
)
def test_growth_from_some_views_is_bounded(points: int, size: tuple[int, int], most: int) -> None:
    scene = made(24)
    scene.points, scene.point_colors = scene.points[:points], scene.point_colors[:points]
    for index, view in enumerate(scene.views):
        scene.views[index] = replace(view, camera=view.camera.resized(*size))
    found = [finding for finding in findings(scene) if finding.kind == "some views"]
    assert f"support about {most:,} Gaussians" in found[0].text
    (answer,), config = answered(found, TrainConfig())
    assert config == replace(TrainConfig(), thinning=0.2, penalty=0.02, density=DensityConfig(max_gaussians=most))
    taken = f"--thinning 0.2 --penalty 0.02 --density.max-gaussians {most}"
    assert paragraph([answer], 24, auto=True).endswith(f". --auto takes {taken}")
    own = TrainConfig(density=DensityConfig(max_gaussians=50))
    (answer,), config = answered(found, own, {"density.max_gaussians"})
    assert config == replace(own, thinning=0.2, penalty=0.02)
    mcmc = replace(own, density=replace(own.density, growth="mcmc"))
    assert answered(found, mcmc, {"density.max_gaussians"})[1] == replace(mcmc, thinning=0.2)


def test_a_run_from_some_views_is_evaluated_early_if_views_are_held_out() -> None:
    scene = made(24)
    for index in (0, 8, 16):
        scene.views[index] = replace(scene.views[index], split="test")
    (finding,) = (found for found in findings(scene, iterations=3000) if found.kind == "some views")
    (answer,), config = answered([finding], TrainConfig(iterations=3000))
    assert config.eval_at == (1000,)
    assert paragraph([answer], 24, auto=True).endswith(" --eval-at 1000")
    (answer,), config = answered([finding], TrainConfig(iterations=3000, eval_at=(50,)), {"eval_at"})
    assert config.eval_at == (50,)
    assert config.density.max_gaussians == answer.settings["density.max_gaussians"]


def test_few_steps() -> None:
    scene = made(40)
    for steps, expected in ((2399, ["few steps"]), (2400, []), (1000, ["few steps"]), (999, []), (0, [])):
        assert [finding.kind for finding in findings(scene, iterations=steps)] == expected, steps
    (finding,) = findings(scene, iterations=2000)
    assert finding.text.startswith("2,000 steps pass 50.0 times through the 40 training photographs")
    many = made(200)
    assert findings(many, iterations=10_001) == [], "nothing is known of longer trainings"
    assert [finding.kind for finding in findings(many, iterations=10_000)] == ["few steps"]


def test_a_sky() -> None:
    """Blue down to the horizon, where no point is, in some pictures that are stored on their side too."""
    scene = made()
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for index, view in enumerate(scene.views):
        pixels = scene.thumbnails[view.name].pixels.copy()
        pixels[: DOWN // 7] = (0.5, 0.6, 0.85)
        if index % 4 == 0:
            camera = replace(
                view.camera,
                width=DOWN,
                height=ACROSS,
                cx=DOWN / 2,
                cy=ACROSS / 2,
                rotation=turn @ view.camera.rotation,
                translation=turn @ view.camera.translation,
            )
            scene.views[index] = replace(view, camera=camera, lens=view.lens.resized(DOWN, ACROSS))
            pixels = np.rot90(pixels, -1)
        changed(scene, index, pixels=pixels)
    (found,) = findings(scene)
    assert found.kind == "sky"
    assert found.text.startswith("32 photographs have a sky without points, which covers 14 % of their area")


def test_points_without_colours_say_nothing_of_exposures() -> None:
    scene = made()
    for index, view in enumerate(scene.views):
        changed(scene, index, pixels=scene.thumbnails[view.name].pixels * np.float32(2 ** (-index / 24)))
    assert kinds(scene) == ["exposure"]
    assert kinds(replace_points(scene, colourless=np.ones(len(scene.points), bool))) == []
    assert kinds(replace_points(scene, point_colors=np.full_like(scene.point_colors, 0.5))) == []


def replace_points(scene: Scene, **changes: object) -> Scene:
    """The scene with other points, and the same thumbnails."""
    other = replace(scene, **changes)  # type: ignore[arg-type]
    other.__dict__["thumbnails"] = scene.thumbnails
    return other


def test_a_white_table_below_is_no_sky() -> None:
    scene = made()
    for index, view in enumerate(scene.views):
        pixels = scene.thumbnails[view.name].pixels.copy()
        pixels[-DOWN // 6 :] = (0.97, 0.97, 0.97)
        changed(scene, index, pixels=pixels)
    assert kinds(scene) == []


def test_blur() -> None:
    scene = made()
    changed(scene, 7, sharpness=0.3)
    assert only(findings(scene)) == Finding("blur", "1 photographs are more blurred than the others (07.png)")


def test_sharpness_is_of_the_blur_alone() -> None:
    rng = np.random.default_rng(2)
    noise = ndimage.gaussian_filter(rng.random((400, 600)), 0.8).astype(np.float32)
    sharp = sharpness_of(noise)
    assert abs(sharpness_of(0.3 * noise + 0.2) / sharp - 1) < 1e-3
    assert sharpness_of(ndimage.gaussian_filter(noise, 2.0)) < 0.72 * sharp
    assert sharpness_of(np.zeros((40, 40), np.float32)) == 1.0


def test_copies() -> None:
    scene = made()
    noise = np.random.default_rng(3).normal(0, 0.5 / 255, (DOWN, ACROSS, 3))
    changed(scene, 9, pixels=(scene.thumbnails["04.png"].pixels + noise).astype(np.float32))
    assert only(findings(scene)).text == "1 photographs are duplicates (09.png is 04.png)"


def test_alpha_and_fisheyes() -> None:
    scene = made()
    for index in range(24):
        changed(scene, index, transparent=0.5)
    assert kinds(scene) == ["alpha"]
    assert [finding.kind for finding in findings(scene, MaskUse(alpha="ignore"))] == []
    lens = Lens("OPENCV_FISHEYE", ACROSS, DOWN, (30.0, 30.0, ACROSS / 2, DOWN / 2, 0.0, 0.0, 0.0, 0.0))
    scene = made()
    scene.views[:] = [replace(view, lens=lens) for view in scene.views]
    assert kinds(scene) == ["undistorted"]


@pytest.mark.parametrize(("part", "kind"), [(0.3, "cut out"), (0.9, "masks")])
def test_masks_that_are_not_used(tmp_path: Path, part: float, kind: str) -> None:
    folder = write_scene(tmp_path / "scene")
    (folder / "masks").mkdir()
    mask = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    side = part**0.5 / 2
    mask[round((0.5 - side) * HEIGHT) : round((0.5 + side) * HEIGHT)] = 1
    mask[:, : round((0.5 - side) * WIDTH)] = mask[:, round((0.5 + side) * WIDTH) :] = 0
    if kind == "masks":
        mask[:] = 1
        mask[: HEIGHT // 3] = 0
    for index in range(VIEWS):
        write_image(folder / "masks" / f"{index:02d}.png", mask)
    assert kind in kinds(load_scene(folder))
    use = MaskUse("ignore")
    assert kind not in [finding.kind for finding in findings(load_scene(folder, masks=use), use)]
    write_image(folder / "masks" / "stranger.png", mask)
    (found,) = (finding for finding in findings(load_scene(folder)) if "mask" in finding.kind)
    assert found.kind == "strange masks"
    assert found.text.startswith(f"{VIEWS} of {VIEWS} photographs have masks, which cannot be used (")
    assert "fit no photograph (stranger.png): expected names such as 00.png" in found.text
    for path in (folder / "masks").iterdir():
        if path.stem != "stranger":
            path.unlink()
    assert not [kind for kind in kinds(load_scene(folder)) if "mask" in kind], "masks of something else"


def test_every_answer_is_a_setting_that_can_be() -> None:
    for kind, options in SETTINGS_BY_FINDING.items():
        for option in options:
            assert with_settings(TrainConfig(), option) != TrainConfig(), kind
    assert not SETTINGS_BY_FINDING.keys() & ADVICE_BY_FINDING.keys()


def test_answers_that_do_not_go_together() -> None:
    found = [Finding("exposure", "a"), Finding("cut out", "b"), Finding("blur", "c")]
    answers, config = answered(found, TrainConfig())
    assert (config.appearance, config.masks) == ("exposure", "ignore")
    text = paragraph(answers, 3, auto=True)
    assert text.startswith("inspected 3 photographs: a (--appearance exposure); b (--masks ignore); c: leave them out")
    assert text.endswith(". --auto takes --appearance exposure --masks ignore")
    answers, config = answered(found, TrainConfig(), given={"appearance"})
    assert (config.appearance, config.masks) == ("none", "transparent")
    text = paragraph(answers, 3, auto=False)
    assert "a (you set --appearance)" in text
    assert text.endswith("c: leave them out if other photographs show the same. --auto would take --masks transparent")
    transparent = TrainConfig(masks="transparent")
    answers, config = answered(found[:1], transparent)
    assert config == transparent
    assert "is incompatible with the other settings" in answers[0].words


def test_few_views_are_trained_for_fewer_steps() -> None:
    """By high rates for so many, unless steps, a schedule or rates are somebody's own."""
    few = [Finding("few views", "a")]
    (answer,), config = answered(few, TrainConfig(antialiased=True))
    steps = int(answer.settings["iterations"])
    taken = f"--thinning 0.2 --penalty 0.02 --schedule high-rates --iterations {steps} --optimiser.sh-rest-rate 0.0004"
    assert answer.words == f"a ({taken})"
    high = scheduled("high-rates", steps)
    high = replace(high, optimiser=replace(high.optimiser, sh_rest_rate=4e-4))
    assert config == replace(high, thinning=0.2, penalty=0.02, antialiased=True)
    own = replace(TrainConfig(), optimiser=replace(TrainConfig().optimiser, means_rate=1e-4))
    for mine, given in (
        (TrainConfig(), {"iterations"}), (TrainConfig(), {"schedule"}), (own, {"optimiser.means_rate"}),
        (TrainConfig(), {"density.stop"}), (TrainConfig(), {"sh_degree_every"}),
        (bundled("fast", None, 7000), {"preset"}), (TrainConfig(eval_at=(steps + 1,)), {"eval_at"}),
    ):  # fmt: skip
        (answer,), config = answered(few, mine, given)
        assert answer.settings == {"thinning": 0.2, "penalty": 0.02}
        assert config == replace(mine, thinning=0.2, penalty=0.02)
    mcmc = TrainConfig(density=DensityConfig(growth="mcmc", max_gaussians=1000))
    assert answered(few, mcmc)[1] == replace(mcmc, thinning=0.2), "which has penalties of its own"
    (answer,), config = answered(few, TrainConfig(), {"thinning"})
    assert (answer.words, config) == ("a (you set --thinning)", TrainConfig())


def test_many_photographs_are_trained_by_passes() -> None:
    """At the default number of steps, from 1001 photographs on; not where steps are given."""
    assert [each.kind for each in findings(made(40), iterations=30_000)] == []
    many = made(1010)
    assert findings(many) == [], "the number of steps is unknown"
    (found,) = findings(many, iterations=30_000)
    assert found.kind == "few passes"
    assert found.text == "30,000 steps pass 29.7 times through the 1,010 training photographs"
    (answer,), config = answered([found], TrainConfig(), photographs=1010)
    assert answer.words == f"{found.text} (--passes 30)"
    assert config == by_passes(TrainConfig(), 30, 1010)
    (answer,), config = answered([found], TrainConfig(), {"density.stop"}, photographs=1010)
    assert (config.iterations, config.density.stop) == (30_300, TrainConfig().density.stop)
    (answer,), config = answered([found], TrainConfig(), {"iterations"}, photographs=1010)
    assert (answer.words, config) == (f"{found.text} (you set --iterations)", TrainConfig())


def test_few_steps_are_trained_with_high_rates() -> None:
    """Whatever grows the model; not where rates or a schedule are given."""
    few = [Finding("few steps", "a")]
    mcmc = TrainConfig(iterations=7000, density=DensityConfig(growth="mcmc", max_gaussians=1000))
    (answer,), config = answered(few, mcmc, {"iterations", "density.growth", "density.max_gaussians"})
    high = scheduled("high-rates", 7000)
    assert answer.words == "a (--schedule high-rates)"
    assert config == replace(high, density=replace(high.density, growth="mcmc", max_gaussians=1000))
    stopped = replace(mcmc, density=replace(mcmc.density, stop=4000))
    late = replace(mcmc, density=replace(mcmc.density, start=6000, stop=7000))
    for mine, given, words in (
        (TrainConfig(), {"schedule"}, "you set --schedule"), (stopped, {"density.stop"}, "you set --density.stop"),
        (late, {"density.start"}, "you set --density.start"),
        (TrainConfig(), {"sh_degree_every", "sh_degree"}, "you set --sh-degree-every"),
        (bundled("fast", None, 7000), {"preset"}, "--schedule high-rates is incompatible with the other settings"),
    ):  # fmt: skip
        (answer,), config = answered(few, mine, given)
        assert (answer.words, config) == (f"a ({words})", mine)


@pytest.mark.parametrize("name", ["short", "high-rates"])
def test_settings_of_schedules_are_known(name: str) -> None:
    density = {field.partition(".")[2] for field in SCHEDULED_SETTINGS if field.startswith("density.")}
    paper, bundle = TrainConfig(iterations=7000), scheduled(name, 7000)  # type: ignore[arg-type]
    same = {field: getattr(paper.density, field) for field in density}
    assert replace(bundle, sh_degree_every=paper.sh_degree_every, optimiser=paper.optimiser,
                   density=replace(bundle.density, **same)) == paper  # fmt: skip


@pytest.mark.slow
def test_auto_takes_what_answers(tmp_path: Path, capfd: Capture) -> None:
    folder = write_scene(tmp_path / "scene", alpha=True)
    short = ("--iterations", "1", "--sh-degree", "0", "--no-report")
    assert main(["train", str(folder), "-o", str(tmp_path / "plain"), *short]) == 0
    told = capfd.readouterr().err
    assert "of the photographs' area is transparent" in told
    assert "(--alpha transparent)" in told
    assert Run.open(tmp_path / "plain").config.alpha == "blend"
    assert main(["train", str(folder), "-o", str(tmp_path / "auto"), *short, "--auto"]) == 0
    taken = capfd.readouterr().err.partition("--auto takes ")[2].splitlines()[0]
    assert taken == "--thinning 0.2 --penalty 0.02 --alpha transparent"
    assert Run.open(tmp_path / "auto").config.alpha == "transparent"
    assert main(["train", "-o", str(tmp_path / "auto"), "--resume", "--auto"]) == 2
    assert "--auto and --resume exclude each other" in capfd.readouterr().err


def test_a_glance_is_small_and_true() -> None:
    image = np.zeros((640, 960, 4), np.float32)
    image[:, 480:] = 1
    thumbnail = thumbnail_of(image)
    assert thumbnail.pixels.shape == (64, 96, 3)
    assert (thumbnail.pixels[:, :48] == 0).all()
    assert (thumbnail.pixels[:, 48:] == 1).all()
    assert thumbnail.transparent == 0.5
