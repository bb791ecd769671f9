# SPDX-License-Identifier: Apache-2.0
"""clsplat bench: the contract of its JSON, counts against a brute-force count, limits, the plot, wrong calls."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import scenes
from benched import SMALL, quick_limits
from calls import Capture, printed, rejected
from pipeline import BACKGROUND, Pipeline, shaped
from quick import quick
from tiny import run_steps, write_scene

from clsplat.bench import settings as tradeoff
from clsplat.bench import stages as bench_stages
from clsplat.bench import workload as bench_subject
from clsplat.cli.main import main
from clsplat.config.presets import RASTERIZER_PRESETS
from clsplat.config.rasterizer import BenchSwitches, RasterizerConfig
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import SPLAT, TILE
from clsplat.reference import render as reference
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.stages.blend import count_pairs
from clsplat.stages.peak import Limits

LIMITS = Limits(1e9, 5e8, 1e10, 8, 1)
FRAME = {"project", "duplicate", "ranges", "blend"}
STEP = {"target", "loss", "blend_grad", "project_grad", "statistics"}


@pytest.fixture(scope="session")
def profiled(default_device: Device) -> Device:
    """With a queue that profiles, as the verb opens it."""
    return Device(default_device.cl_device, profile=True)


def counted(pipeline: Pipeline) -> tuple[int, int]:
    frame, rasterizer = pipeline.frame, pipeline.rasterizer
    lists, splats = frame.listed.lists, frame.projected.splats
    return count_pairs(rasterizer.device, rasterizer.work, lists, splats, frame.background, pipeline.camera)


def first_cell(low: float, size: float, count: int) -> int:
    return int(np.ceil(np.clip((low - 0.01 - (size - 0.5)) / size, 0, count)))


def end_cell(high: float, size: float, count: int) -> int:
    return int(np.clip((high + 0.01 - 0.5) / size + 1, 0, count))


def cell_of_pixel(lanes: int) -> np.ndarray:
    """Of each pixel (16, 16) of a tile, the number of its cell: blocks 4 wide, of as many pixels as lanes."""
    wide = 1 if lanes == 1 else 4
    y, x = np.mgrid[:TILE, :TILE]
    return (y // (lanes // wide)) * (TILE // wide) + x // wide


def in_box(splat: np.ndarray, x: int, y: int, lanes: int) -> np.ndarray:
    """The cells of the tile at (x, y) that the Gaussian's box reaches."""
    of = dict(zip(SPLAT, splat.astype(np.float64), strict=True))
    mx, my = of["PIXEL_X"] - x + of["SUB_X"], of["PIXEL_Y"] - y + of["SUB_Y"]
    wide = 1 if lanes == 1 else 4
    high = lanes // wide
    rows = slice(first_cell(my - of["HALF_H"], high, TILE // high), end_cell(my + of["HALF_H"], high, TILE // high))
    columns = slice(first_cell(mx - of["HALF_W"], wide, TILE // wide), end_cell(mx + of["HALF_W"], wide, TILE // wide))
    inside = np.zeros((TILE // high, TILE // wide), np.bool_)
    inside[rows, columns] = True
    return inside.ravel()


def in_ellipse(splat: np.ndarray, x: int, y: int, lanes: int) -> np.ndarray:
    """The cells of the tile at (x, y) that have a pixel in the Gaussian's ellipse."""
    of = dict(zip(SPLAT, splat.astype(np.float64), strict=True))
    rows, columns = np.mgrid[:TILE, :TILE] + 0.5
    dx, dy = of["PIXEL_X"] - x + of["SUB_X"] - columns, of["PIXEL_Y"] - y + of["SUB_Y"] - rows
    power = of["LOG2O"] - (of["L11"] * dx + of["L12"] * dy) ** 2 - (of["L22"] * dy) ** 2
    inside = np.zeros(TILE * TILE // lanes, np.bool_)
    np.logical_or.at(inside, cell_of_pixel(lanes), power >= np.log2(1 / 255))
    return inside


def walks(pipeline: Pipeline) -> Iterator[tuple[int, int, np.ndarray, np.ndarray, int]]:
    """Of each tile: x and y, the splats of its list, its stops (16, 16), and the index of its first pair."""
    frame = pipeline.frame
    ranges, listed = frame.listed.lists.ranges.get().astype(int), frame.listed.lists.gaussian_from_sorted.get()
    splats, stops = frame.projected.splats.get(), frame.blended.stops.get()
    tiles_x = -(-pipeline.camera.width // TILE)
    for tile, (begin, end) in enumerate(ranges):
        x, y = tile % tiles_x * TILE, tile // tiles_x * TILE
        yield x, y, splats[listed[begin:end]], stops[y : y + TILE, x : x + TILE], begin


def brute_force_evaluated(pipeline: Pipeline, lanes: int, reached: Callable[..., np.ndarray]) -> int:
    """Lanes of the cells that each Gaussian reaches, up to where the last of the cell's pixels has ended, or of the
    tile's, where a work-item has no bits for its cells."""
    cells = TILE * TILE // lanes
    total = 0
    for x, y, splats, stops, begin in walks(pipeline):
        last = np.full(cells, stops.max(), np.int32) if lanes == 1 else np.zeros(cells, np.int32)
        np.maximum.at(last, cell_of_pixel(lanes), stops)
        for i, splat in enumerate(splats, begin):
            total += lanes * int((reached(splat, x, y, lanes) & (i <= last)).sum())
    return total


def brute_force_of_group(pipeline: Pipeline, items: int) -> int:
    """Pixels of the blocks of 4x8 that each Gaussian reaches, of those that have an open pixel where its batch begins;
    where it reaches more than half of a warp's blocks, of all of them (kernels/shared/blocks.h)."""
    y, x = np.divmod(np.arange(TILE * TILE), TILE)
    block, blocks = y // 8 * 4 + x // 4, TILE * TILE // 32
    warps, batch = items // 32, max(items, 64)
    total = 0
    for tile_x, tile_y, splats, stops, begin in walks(pipeline):
        last = np.full(blocks, -1)
        np.maximum.at(last, block, stops.ravel())
        for i, splat in enumerate(splats):
            inside = np.bincount(block, weights=in_ellipse(splat, tile_x, tile_y, 1), minlength=blocks) > 0
            of_warps = (inside & (last >= begin + i // batch * batch)).reshape(warps, -1).sum(1)
            total += 32 * int(np.where(of_warps > blocks // warps // 2, blocks // warps, of_warps).sum())
    return total


@pytest.mark.slow
@pytest.mark.parametrize("name", ["overlap", "saturating", "many_per_tile", "random_cloud"])
def test_contributing_pairs_are_those_of_the_reference(default_device: Device, name: str) -> None:
    scene = scenes.NAMED[name]()
    wanted = reference.forward(*scene, BACKGROUND).blended
    got, _ = counted(Pipeline.run(shaped(default_device, 8, 1), scene))
    doubtful = wanted.margin < 1e-5  # pixels where a threshold may fall the other way, by one Gaussian or so
    assert abs(got - wanted.count.sum()) <= doubtful.sum()
    assert got > 0


@pytest.mark.slow
def test_contributing_pairs_exactly(default_device: Device) -> None:
    scene = scenes.NAMED["one"]()
    wanted = reference.forward(*scene, BACKGROUND).blended
    assert wanted.margin.min() > 1e-5
    assert counted(Pipeline.run(default_device, scene))[0] == wanted.count.sum()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["overlap", "saturating", "random_cloud"])
def test_evaluated_pairs_of_a_lone_item_are_those_of_a_brute_force_count(default_device: Device, name: str) -> None:
    pipeline = Pipeline.run(shaped(default_device, 1, 1), scenes.NAMED[name]())
    contributing, evaluated = counted(pipeline)
    assert evaluated == brute_force_evaluated(pipeline, 1, in_box)
    assert contributing == counted(Pipeline.run(shaped(default_device, 8, 1), scenes.NAMED[name]()))[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["overlap", "saturating", "random_cloud", "needles"])
@pytest.mark.parametrize("items", quick([32, 64, 256], 64))
def test_evaluated_pairs_of_a_group_are_those_of_the_blocks(default_device: Device, items: int, name: str) -> None:
    pipeline = Pipeline.run(shaped(default_device, 1, items), scenes.NAMED[name]())
    contributing, evaluated = counted(pipeline)
    wanted = brute_force_of_group(pipeline, items)
    # as on a CPU; an ellipse between the centres of two rows or columns reaches the block, and has no pixel of it
    assert wanted <= evaluated <= 1.1 * wanted
    assert contributing == counted(Pipeline.run(shaped(default_device, 8, 1), scenes.NAMED[name]()))[0]


@pytest.mark.parametrize("name", quick(["overlap", "saturating", "random_cloud", "needles"], "random_cloud", "needles"))
def test_evaluated_pairs_on_a_cpu_are_those_in_the_ellipse(default_device: Device, name: str) -> None:
    pipeline = Pipeline.run(shaped(default_device, 8, 1), scenes.NAMED[name]())
    _, evaluated = counted(pipeline)
    wanted = brute_force_evaluated(pipeline, 8, in_ellipse)
    # The ellipse is taken a hundredth of a pixel and 0.2 % too wide; what lies between two rows' chords counts.
    assert wanted <= evaluated <= 1.02 * wanted
    assert evaluated < brute_force_evaluated(pipeline, 8, in_box)


def test_switches_show_in_the_counts(default_device: Device) -> None:
    scene = scenes.random_cloud(1000, 8, 100, 70)
    counts = {}
    for name, config in {"default": RasterizerConfig(), "rows": BenchSwitches(row_skip=False)}.items():
        pipeline = Pipeline.run(shaped(default_device, 8, 1), scene)
        pipeline.rasterizer = Rasterizer(pipeline.rasterizer.device, config)
        counts[name] = counted(pipeline)
    assert counts["rows"][0] == counts["default"][0]
    assert counts["rows"][1] > counts["default"][1]


def test_limits_are_finite_in_every_shape(shaped_device: Device) -> None:
    limits = quick_limits(shaped_device)
    for value in (limits.pairs_per_second, limits.gradient_pairs_per_second, limits.copy_bytes_per_second):
        assert np.isfinite(value)
        assert value > 0
    assert limits.lanes == shaped_device.shape.lanes


@pytest.mark.slow
@pytest.mark.parametrize("shape", [None, (1, 64)], ids=str)
def test_stages(profiled: Device, shape: tuple[int, int] | None) -> None:
    device = profiled.with_shape(lanes=shape[0], items=shape[1]) if shape else profiled
    result = bench_stages.bench(bench_subject.synthetic(300, 50, 40), device, repeat=2, limits=LIMITS)
    stages = (FRAME | STEP) - ({"target"} if shape else set())  # the loss of groups reads the photograph itself
    assert set(result["stages"]) >= stages
    assert result["timer"] == "events"
    for name in stages:
        row = result["stages"][name]
        assert row["ms"] > 0
        assert row["wall_ms"] > 0
        assert row["launches"] > 0
        assert row["bytes"] > 0
        assert sum(row["kernels"].values()) == pytest.approx(row["ms"], rel=0.5)  # medians of each, and of the sums
    blend = result["stages"]["blend"]
    assert blend["pairs_per_second"] == pytest.approx(1e3 * result["pairs"]["contributing"] / blend["ms"])
    assert blend["share_of_arithmetic"] == pytest.approx(blend["pairs_per_second"] / 1e9)
    gradient = result["stages"]["blend_grad"]
    assert gradient["share_of_arithmetic"] == pytest.approx(gradient["pairs_per_second"] / 5e8)
    # Parameters and both moments of 59 floats, read and written; splats, counts of tiles and places of slots, read, and
    # gradients on the image, written; camera and slots beside these.
    bytes_of_rows = 300 * (59 * 4 * 3 * 2 + 64 + 4 + 4 + 8)
    assert bytes_of_rows < result["stages"]["project_grad"]["bytes"] < bytes_of_rows + 40 * result["pairs"]["listed"]


MOST_LAUNCHES = 40
"""Kernels of a training step, in a GPU's shape and in a CPU's."""


@pytest.mark.parametrize("shape", [pytest.param((1, 64), marks=pytest.mark.slow), None], ids=str)
@pytest.mark.parametrize("count", quick([300, 6000], 6000))
@pytest.mark.parametrize("by_capacity", quick([False, True], False))
def test_what_a_step_gives_the_queue(
    device: Device, monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int] | None, count: int, by_capacity: bool
) -> None:
    """A step waits for one number, by capacity for none, and for no copy to the device, whichever sort its size asks
    for."""
    monkeypatch.setenv("CLSPLAT_BY_CAPACITY", str(int(by_capacity)))
    if shape:
        device = device.with_shape(lanes=shape[0], items=shape[1])
    subject = bench_subject.synthetic(count, 320, 200)
    trainer = bench_stages.trainer_of(subject, device, RasterizerConfig())

    def frame() -> object:
        return trainer.rasterizer.forward(trainer.parameters, subject.camera, trainer.background, backward=False)

    for work in (trainer.train_step, frame):
        work()
        work()  # by capacity the second is the first that knows one
        calls = bench_stages.calls_of(device, work)
        assert calls.blocking_reads <= (0 if by_capacity and work == trainer.train_step else 1)
        assert calls.blocking_writes == 0
        assert 0 < calls.launches <= MOST_LAUNCHES


def test_wall_time_where_events_have_none(default_device: Device) -> None:
    result = bench_stages.bench(bench_subject.synthetic(200, 40, 30), default_device, repeat=1, limits=LIMITS)
    assert result["timer"] == "wall"
    assert all(result["stages"][name]["ms"] == result["stages"][name]["wall_ms"] for name in FRAME | STEP)


def test_nothing_is_recorded_unless_asked(profiled: Device) -> None:
    assert not profiled.recorder.on
    with profiled.recorder.recording(wait=False) as stages:
        pass
    assert stages == {}
    assert not profiled.recorder.on


def test_measuring_leaves_the_model_as_it_is(profiled: Device) -> None:
    subject = bench_subject.synthetic(200, 40, 30)
    trainer = bench_stages.trainer_of(subject, profiled, RasterizerConfig())
    run_steps(3, trainer)
    after = trainer.gaussians()
    for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_array_equal(getattr(after, name), getattr(subject.gaussians, name))
    assert trainer.model.first["means"].get().any(), "there was a gradient"


def test_synthetic_scene_is_the_same_every_time() -> None:
    first, second = bench_subject.synthetic(50, 40, 30), bench_subject.synthetic(50, 40, 30)
    np.testing.assert_array_equal(first.gaussians.means, second.gaussians.means)
    first.gaussians.check()


@pytest.mark.slow
@pytest.mark.usefixtures("_quick")
def test_json_has_the_contract(capsys: Capture) -> None:
    flags = ["--json", "--preset", "fast", "--rasterizer.sh-degree-limit", "1"]
    result = json.loads(printed(capsys, ["bench", *SMALL, *flags]).out)
    assert {"device", "driver", "stages", "frame_ms", "iteration_ms", "gaussians", "width", "height", "pairs"} <= set(
        result
    )
    assert (result["gaussians"], result["width"], result["height"]) == (400, 70, 50)
    assert all("ms" in stage for stage in result["stages"].values())
    assert result["frame_calls"]["launches"] < result["iteration_calls"]["launches"]
    assert result["iteration_calls"]["blocking_reads"] == 1
    assert result["frame_host_ms"] > 0 and 0 < result["iteration_host_ms"] < 1e4
    assert {"contributing", "evaluated"} <= set(result["pairs"])
    assert 0 < result["pairs"]["contributing"] <= result["pairs"]["evaluated"]
    assert result["limit"]["pairs_per_second"] > 0
    fast = RASTERIZER_PRESETS["fast"]
    assert result["rasterizer"]["alpha_min"] == fast.alpha_min
    assert result["rasterizer"]["sh_degree_limit"] == 1, "a flag goes before the preset"


@pytest.mark.usefixtures("_quick")
def test_table(capsys: Capture) -> None:
    lines = printed(capsys, ["bench", *SMALL]).out.splitlines()
    assert {line.split()[0] for line in lines if line} >= FRAME | STEP
    assert "synthetic: 400 Gaussians" in "\n".join(lines)
    queue = [line.split() for line in lines if line.startswith(("queue", "training step  "))]
    assert queue[0][-6:] == ["blocking", "writes", "blocking", "reads", "host", "ms"]
    assert queue[1][-3:-1] == ["0", "1"]


@pytest.mark.slow
@pytest.mark.usefixtures("_quick")
def test_scene_run_and_model(tmp_path: Path, capsys: Capture) -> None:
    scene, run = write_scene(tmp_path / "scene"), tmp_path / "run"
    assert main(["train", str(scene), "-o", str(run), "--iterations", "2"]) == 0
    loose = tmp_path / "loose.ply"
    Gaussians.load(run / "model.ply").save(loose)
    capsys.readouterr()
    for source, size in ((scene, (48, 40)), (run, (48, 40)), (run / "model.ply", (48, 40)), (loose, (24, 20))):
        extra = ["--size", "24x20"] if source == loose else []
        result = json.loads(printed(capsys, ["bench", source, "--repeat", "1", "--json", *extra]).out)
        assert (result["width"], result["height"]) == size
        assert result["pairs"]["contributing"] > 0
        assert result["source"] == str(source)


def test_facing_camera_sees_the_model() -> None:
    gaussians = bench_subject.synthetic(500, 64, 48).gaussians
    _, camera = bench_subject.facing(gaussians, 80, 60)
    p = gaussians.means @ camera.rotation.T + camera.translation
    pixels = p[:, :2] / p[:, 2:] * camera.fx + (camera.cx, camera.cy)
    seen = (p[:, 2] > camera.near) & (pixels > 0).all(axis=1) & (pixels < (80, 60)).all(axis=1)
    assert seen.mean() > 0.8


@pytest.mark.parametrize("crop", [(0, 0, 70, 50), (13, 9, 30, 20)], ids=str)
def test_crop_of_the_reference_is_part_of_it(crop: tuple[int, int, int, int]) -> None:
    gaussians, camera = scenes.NAMED["random_cloud"]()
    whole, _ = reference.render(gaussians, camera)
    x, y, width, height = crop
    part = tradeoff.reference_crop(gaussians, camera, crop)
    np.testing.assert_allclose(part, whole[y : y + height, x : x + width], atol=1e-12)


def test_settings_hold_every_switch_and_preset() -> None:
    named = tradeoff.settings()
    assert "preset exact = default" in named
    assert {config.switches() for config in RASTERIZER_PRESETS.values()} <= set(named.values())
    for field in BenchSwitches.__dataclass_fields__:
        assert any(getattr(config, field) != getattr(BenchSwitches(), field) for config in named.values()), field


@pytest.mark.slow
def test_time_against_error(profiled: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tradeoff, "REFERENCE_CROP_SIDE_PX", 48)
    candidates = {
        "exact": RASTERIZER_PRESETS["exact"],
        "no row-skip": BenchSwitches(row_skip=False),
        "coarse": RasterizerConfig(alpha_min=8 / 255),
    }
    result = tradeoff.compare(bench_subject.synthetic(300, 70, 50), profiled, candidates, repeat=1)
    exact, rows, coarse = result["points"]
    assert result["error_is_against"] == "the exact preset's frame"
    assert result["crop"] == [11, 1, 48, 48]
    assert exact["max_abs"] == rows["max_abs"] == 0.0
    assert exact["psnr"] == tradeoff.MAX_PSNR_DB
    assert 0 < coarse["max_abs"] < 0.3
    assert 20 < coarse["psnr"] < 80
    assert result["exact_against_float64"]["max_abs"] < 2e-5
    assert any(point["on_front"] for point in result["points"])
    assert all(point["iteration_ms"] > 0 for point in result["points"])
    assert result["exact_switches_faster"] is None, "nothing has them off"


@pytest.mark.slow
def test_exact_switches_together(profiled: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tradeoff, "REFERENCE_CROP_SIDE_PX", 48)
    every = tradeoff.settings()
    off = every[tradeoff.ALL_EXACT_SWITCHES_OFF]
    for field, value in asdict(off).items():
        if isinstance(value, bool | str) and field != "sh_storage":  # it and the numbers are approximations
            assert value != getattr(BenchSwitches(), field), field
    assert (off.tile_test, off.alpha_min) == ("square", BenchSwitches().alpha_min)
    times = iter([50.0, 100.0, 150.0, 210.0])  # of a frame and of a step, on and off
    monkeypatch.setattr(Device, "timed", lambda _device, work: (work(), next(times)))
    candidates = {"preset exact = default": RASTERIZER_PRESETS["exact"], tradeoff.ALL_EXACT_SWITCHES_OFF: off}
    result = tradeoff.compare(bench_subject.synthetic(300, 70, 50), profiled, candidates, repeat=1)
    assert [(point["frame_ms"], point["iteration_ms"]) for point in result["points"]] == [(50, 100), (150, 210)]
    assert result["points"][1]["max_abs"] == 0.0
    assert result["exact_switches_faster"] == {"frame": 3.0, "iteration": 2.1}
    text = tradeoff.settings_table(result)
    assert "a frame 3.00 times faster, and a training step 2.10 times" in text
    assert "step ms" in text


@pytest.mark.slow
@pytest.mark.usefixtures("_quick")
def test_a_held_model_is_what_frames_are_measured_of(profiled: Device) -> None:
    subject = bench_subject.synthetic(300, 50, 40)
    sizes = []
    for storage in ("float", "half"):
        config = RasterizerConfig(sh_storage=storage)
        result = bench_stages.bench(subject, profiled, config, repeat=1, limits=LIMITS)
        sizes.append(result["stages"]["project"]["bytes"])
    assert sizes[0] - sizes[1] == 300 * 90


def test_small_frames_are_compared_with_float64(profiled: Device) -> None:
    result = tradeoff.compare(
        bench_subject.synthetic(200, 40, 30), profiled, {"exact": RASTERIZER_PRESETS["exact"]}, repeat=1
    )
    assert result["error_is_against"] == "the float64 reference"
    assert result["crop"] == [0, 0, 40, 30]
    assert 90 < result["points"][0]["psnr"] < tradeoff.MAX_PSNR_DB


def test_front() -> None:
    assert tradeoff.front([(1, 1), (2, 2), (3, 1), (1, 0), (2, 2)]) == [True, True, False, False, True]


def test_what_approximates() -> None:
    exact = asdict(RASTERIZER_PRESETS["exact"])
    off = asdict(tradeoff.settings()[tradeoff.ALL_EXACT_SWITCHES_OFF])
    for field in exact:  # a new setting is one or the other
        assert (field in tradeoff.APPROXIMATING_SETTINGS) != (off[field] != exact[field]), field
    named = {name for name, config in tradeoff.settings().items() if tradeoff.approximate(config)}
    for name in ("preset fast", "extent 3sigma", "sh-storage half", "alpha-min 2/255"):
        assert name in named
    assert tradeoff.ALL_EXACT_SWITCHES_OFF not in named
    assert not any(name.startswith(("no ", "tile", "key", "depth", "preset exact")) for name in named)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--size", "100"], "--size 100"),
        (["--size", "0x5"], "--size 0x5"),
        (["--gaussians", "0"], "--gaussians 0"),
        (["--gaussians", "99999999999"], "--gaussians 99999999999: expected at most "),
        (["--repeat", "0"], "--repeat 0"),
        (["nowhere.ply"], "nowhere.ply"),
        (["--plot", "a.pdf"], "a.pdf"),
        (["--plot", "nowhere/a.svg"], "nowhere"),
        (["--rasterizer.alpha-min", "0"], "--rasterizer.alpha-min 0.0"),
        (["--preset", "quick"], "quick"),
        (["--device", "no such device"], "no such device"),
    ],
    ids=str,
)
def test_wrong_calls_are_one_line(arguments: list[str], named: str, capsys: Capture) -> None:
    assert named in rejected(capsys, ["bench", *arguments])


@pytest.mark.slow
def test_preset_in_training(tmp_path: Path, capsys: Capture) -> None:
    scene, run = write_scene(tmp_path / "scene"), tmp_path / "run"
    printed(capsys, ["train", scene, "-o", run, "--iterations", "1", "--preset", "fast"])
    assert "alpha_min = 0.0078" in (run / "config.toml").read_text()
    assert "--preset fast and --resume" in rejected(capsys, ["train", "-o", run, "--resume", "--preset", "fast"])
