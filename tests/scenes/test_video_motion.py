# SPDX-License-Identifier: Apache-2.0
"""Motion between frames, and the choice of frames by it, on measurements that are made by hand or known by shifts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from clsplat.scenes.video.choice import (
    MAX_DEFAULT_FRAMES,
    MAX_GAP_STRETCHES,
    MOTION_PER_FRAME,
    SMOOTH_SHARPNESS,
    alike,
    blurred_frames,
    choose,
    default_count,
    fast_frames,
    shaken_frames,
    travelled,
)
from clsplat.scenes.video.colours import Coding
from clsplat.scenes.video.motion import LOST_MOTION, BlockSpectra, Measurements, Meter, reduced_luma
from clsplat.scenes.video.preview import parallax_of, preview, rotation_field
from clsplat.scenes.video.reading import VideoFacts

FACTS = VideoFacts(1920, 1080, None, 0, "h264", Coding(1, 1, 1, full_range=False))
PLACES = np.array([(x, y) for y in (-0.2, 0.0, 0.2) for x in (-0.35, -0.1, 0.1, 0.35)])


def texture(seed: int = 0) -> NDArray[np.float32]:
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).uniform(0, 1, (500, 600)), 2)
    return np.asarray((noise - noise.min()) / (noise.max() - noise.min()), np.float32)


def window(picture: NDArray[np.float32], x: float, y: float, size: tuple[int, int] = (135, 240)) -> NDArray[np.float32]:
    """A window of a picture whose content has moved by x, y pixels."""
    moved = ndimage.shift(picture[50:450, 50:500], (y, x), order=3, mode="mirror")
    return np.ascontiguousarray(moved[80 : 80 + size[0], 100 : 100 + size[1]])


@pytest.mark.parametrize(
    ("size", "shift"),
    [
        *(((135, 240), shift) for shift in ((0, 0), (0.3, -0.2), (3, 1.5), (-6.5, 4), (20, -9))),
        *(((240, 135), shift) for shift in ((0.3, -0.2), (-6.5, 4))),
        *(((60, 80), shift) for shift in ((0, 0), (0.3, -0.2), (3, 1.5))),
        *(((32, 32), shift) for shift in ((0, 0), (0.3, -0.2))),
    ],
)
def test_a_shift_is_measured_to_a_tenth_of_a_pixel(size: tuple[int, int], shift: tuple[float, float]) -> None:
    first, second = (BlockSpectra.of(window(texture(), *each, size)) for each in ((0, 0), shift))
    flow = second.flow_from(first) * max(size)
    matched = np.isfinite(flow[:, 0])
    assert matched.mean() > 0.9
    # the window weighs the middle of a block, which draws results to 0, more in small blocks; 0.1 px of noise
    bias = 0.03 if min(size) > 100 else 0.1
    assert np.abs(np.median(flow[matched], axis=0) - shift).max() < 0.1 + bias * np.abs(shift).max()


def test_another_picture_and_a_wall_have_no_match() -> None:
    one, other = (BlockSpectra.of(window(texture(seed), 0, 0)) for seed in (0, 1))
    assert np.isfinite(other.flow_from(one)[:, 0]).mean() < 0.1
    wall = BlockSpectra.of(np.full((135, 240), 0.4, np.float32))
    assert not wall.textured.any()
    assert np.isnan(wall.flow_from(one)).all()
    meter = Meter(16, 235)
    for seed in (0, 0, 1, 1):
        meter.add(np.rint(16 + 219 * window(texture(seed), 0, 0)).astype(np.uint8), 0.0, whole=True)
    np.testing.assert_allclose(meter.measurements().motion, [0, 0, LOST_MOTION, 0], atol=1e-6)


@pytest.mark.parametrize("shape", [(7, 5), (8, 8), (16, 9), (17, 33)])
@pytest.mark.parametrize("side", [1, 4, 8, 40])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_sums_of_luma(shape: tuple[int, int], side: int, dtype: Any) -> None:
    luma = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape, endpoint=True).astype(dtype)
    factor = -(-max(shape) // side)
    if min(shape) < factor:
        return
    height, width = shape[0] // factor, shape[1] // factor
    wanted = luma[: height * factor, : width * factor].astype(int).reshape(height, factor, width, factor).sum((1, 3))
    np.testing.assert_array_equal(reduced_luma(luma, side), wanted)


def made(motion: list[float], sharpness: list[float] | None = None, fps: float = 10.0) -> Measurements:
    """Measurements of a camera that pans by these longer sides from frame to frame."""
    count = len(motion)
    flow = np.zeros((count, len(PLACES), 2))
    flow[:, :, 0] = np.array(motion)[:, None]
    thumbnails = np.random.default_rng(0).integers(0, 255, (count, 12, 16)).astype(np.uint8)
    sharp = np.array(sharpness if sharpness is not None else [0.5] * count)
    ones = np.ones(count)
    return Measurements(
        np.arange(count) / fps, ones.astype(bool), sharp, 0.5 * ones, ones, flow, np.abs(motion), PLACES, thumbnails
    )  # fmt: skip


def test_stretches_have_equal_motion_and_not_equal_time() -> None:
    """Stands for 50 frames, walks for 50 frames, stands for 50 frames."""
    measured = made([0.0] * 50 + [0.02] * 50 + [0.0] * 50)
    chosen = choose(measured, 10)
    assert len(chosen.frames) == 10
    assert chosen.travelled == pytest.approx(1.0)
    assert (chosen.frames < 55).sum() <= 2 and (chosen.frames >= 95).sum() <= 2  # one of each stop, or near it
    assert np.diff(chosen.frames[1:-1]).max() <= 8  # five frames a stretch, of which any of the middle half


def test_the_sharpest_of_each_stretch_is_chosen() -> None:
    rng = np.random.default_rng(3)
    measured = made([0.02] * 200, rng.uniform(0.4, 0.6, 200).tolist())
    chosen = choose(measured, 20)
    assert len(chosen.frames) == 20
    for frame in chosen.frames:
        inside = measured.sharpness[chosen.stretches == chosen.stretches[frame]]
        assert measured.sharpness[frame] > np.median(inside)
        # the best of all ten frames, or of the middle half of them
        assert (inside > measured.sharpness[frame]).sum() <= 5


def test_a_hand_that_trembles_goes_nowhere() -> None:
    rng = np.random.default_rng(0)
    trembling = np.diff(rng.normal(0, 0.002, 301))  # there and back: 0.5 pixels of 240
    assert travelled(made(trembling.tolist()), np.zeros(300, bool))[-1] < 0.02
    assert len(choose(made(trembling.tolist()), 1).frames) == 1


def test_no_frame_of_a_fast_turn() -> None:
    motion = [0.01] * 40 + [0.12] * 5 + [0.01] * 40 + [LOST_MOTION] * 4 + [0.01] * 20
    measured = made(motion)
    fast = fast_frames(measured)
    turn = np.arange(109)[(np.array(motion) > 0.1)]
    assert fast[turn].all() and fast.sum() <= len(turn) + 2  # the frame before each turn shows its begin
    assert not set(choose(measured, 60).frames) & set(np.flatnonzero(fast))
    assert not fast_frames(made([0.03] * 50)).any()  # an even pan of 0.3 sides per second


def test_no_two_alike_and_no_damaged_or_blurred_frame() -> None:
    sharpness = [0.5] * 60
    sharpness[30:33] = [0.26] * 3
    measured = made([0.02] * 60, sharpness)
    measured.whole[10:14] = False
    measured.thumbnails[40:50] = measured.thumbnails[40]
    measured.sharpness[45] = 0.55
    chosen = choose(measured, 60)
    assert not set(chosen.frames) & {*range(10, 14), *range(30, 33)}
    assert set(chosen.frames) & set(range(40, 50)) == {45}  # the sharpest of ten alike ones
    assert alike(measured.thumbnails[40], measured.thumbnails[41])
    assert not alike(measured.thumbnails[40], measured.thumbnails[39])


def test_detail_that_changes_with_the_view_is_no_blur() -> None:
    """It doubles in eight seconds, halves again, and then stays. Only frames below both neighbours are shaken."""
    views = np.concatenate([np.geomspace(0.1, 0.2, 80), np.geomspace(0.2, 0.1, 80), np.full(80, 0.1)])
    measured = made([0.02] * 240, (views + SMOOTH_SHARPNESS).tolist())
    assert not shaken_frames(measured).any()
    measured.sharpness[[40, 100, 200]] -= 0.15 * views[[40, 100, 200]]
    assert np.flatnonzero(shaken_frames(measured)).tolist() == [40, 100, 200]
    assert not blurred_frames(measured).any()


@pytest.mark.parametrize("seconds", [0.5, 1.0, 2.0])
def test_no_long_part_of_the_path_is_without_frames(seconds: float) -> None:
    """Where the camera sees less detail for a while, its frames count as shaken, but some are taken."""
    half = round(10 * seconds)
    views = np.concatenate(
        [np.full(60, 0.2), np.geomspace(0.2, 0.1, half), np.geomspace(0.1, 0.2, half), np.full(60, 0.2)]
    )
    measured = made([0.02] * len(views), (views + SMOOTH_SHARPNESS).tolist())
    chosen = choose(measured, 30)
    path = travelled(measured, chosen.fast)
    assert np.diff(path[chosen.frames]).max() <= (MAX_GAP_STRETCHES + 1) * chosen.travelled / 30


def test_frames_with_few_neighbours_are_not_shaken() -> None:
    """One frame a second: the neighbours on a side are a single one."""
    sharpness = np.tile([0.35, 0.338], 30)
    measured = made([0.02] * 60, sharpness.tolist(), fps=1.0)
    assert not shaken_frames(measured).any()
    assert len(choose(measured, 60).frames) == 60
    damaged = made([0.02] * 60, [0.35] * 60)
    damaged.sharpness[20:40:2] = 0.9
    damaged.whole[20:40:2] = False
    assert not shaken_frames(damaged)[damaged.whole].any()
    assert not blurred_frames(damaged)[damaged.whole].any()
    assert len(choose(damaged, 60).frames) == 50


def test_a_video_out_of_focus_has_frames() -> None:
    """Its sharpness is below that of a smooth picture."""
    assert len(choose(made([0.02] * 60, [SMOOTH_SHARPNESS - 0.001] * 60), 30).frames) == 30


def test_a_gap_of_blurred_frames_gets_a_shaken_frame_before_them() -> None:
    sharpness = np.full(240, 0.35)
    sharpness[90:96], sharpness[96:104] = 0.335, 0.30
    measured = made([0.02] * 240, sharpness.tolist(), fps=30.0)
    assert {*range(90, 96)} & set(choose(measured, 80).frames)


def test_more_frames_than_are_sharp() -> None:
    """A walk, a rest and a walk, with every third frame shaken: all sharp frames, as for a smaller number."""
    sharpness = np.where(np.arange(180) % 3 == 2, 0.335, 0.35)
    measured = made([0.02] * 60 + [0.0] * 60 + [0.02] * 60, sharpness.tolist())
    counts = [len(choose(measured, count).frames) for count in (100, 125, 150, 180)]
    assert counts == sorted(counts)
    assert counts[1] >= 120


def test_sharp_frames_beside_a_shaken_part_take_its_place() -> None:
    """A hand shakes for 0.6 s, again and again. These frames lack a fifth of their detail."""
    sharpness = np.full(150, 0.35)
    for begin in range(10, 140, 15):
        sharpness[begin : begin + 6] -= 0.02
    measured = made(np.random.default_rng(4).uniform(0.01, 0.03, 150).tolist(), sharpness.tolist())
    shaken = np.flatnonzero(sharpness < 0.34)
    assert shaken_frames(measured)[shaken].all()
    for count in range(20, 50, 3):
        chosen = choose(measured, count)
        assert not set(chosen.frames) & set(shaken)
        # a division into shorter stretches that gives all need not exist
        assert 0.9 * count <= len(chosen.frames) <= count


@pytest.mark.parametrize("count", [1, 2, 3, 9, 10, 11, 200])
def test_a_number_of_frames_that_was_asked_for(count: int) -> None:
    chosen = choose(made([0.02] * 10), count)
    assert len(chosen.frames) == min(count, 10)
    assert chosen.frames[-1] >= 6 or count == 1  # the last stretch is not left out
    assert (np.diff(chosen.frames) > 0).all()


@pytest.mark.parametrize(
    ("sides", "seconds", "frames", "wanted"),
    [
        (5.0, 60.0, 1800, round(5 / MOTION_PER_FRAME)),
        (50.0, 60.0, 1800, MAX_DEFAULT_FRAMES),
        (0.1, 60.0, 1800, 60),
        (5.0, 1.0, 10, 10),
        (0.0, 0.0, 1, 1),
    ],
)
def test_the_number_of_frames_by_length_and_motion(sides: float, seconds: float, frames: int, wanted: int) -> None:
    assert default_count(sides, seconds, frames) == wanted


def test_one_frame() -> None:
    assert choose(made([0.0])).frames.tolist() == [0]


def test_parallax_tells_a_turn_from_a_walk() -> None:
    turn = made([0.0] * 20)
    turn.flow[:] = (rotation_field(PLACES) @ np.array([0.002, -0.02, 0.001]))[None]
    turn.motion[:] = 0.02
    assert parallax_of(turn, choose(turn, 10)) < 1e-9
    forward = made([0.0] * 20)
    forward.flow[:] = 0.1 * PLACES[None]
    forward.motion[:] = 0.02
    assert parallax_of(forward, choose(forward, 10)) > 0.5


@pytest.mark.parametrize(
    ("change", "advice"),
    [
        ({}, ""),
        ({"brightness": 0.1}, "too dark (10 % of white)"),
        ({"sharpness": 0.27}, "not sharp"),
        ({"flow": 0.0}, "hardly moves (0 % of the frame's longer side"),
        ({"turn": 1.0}, "too little parallax (0 % of the motion)"),
        ({"fast": 1.0}, "too fast in 25 % of the frames"),
    ],
)
def test_advice(change: dict[str, float], advice: str) -> None:
    measured = made([0.02] * 40)
    measured.flow[:, :, 1] = 0.1 * PLACES[None, :, 1]  # forward too
    for name in set(change) & {"brightness", "sharpness", "flow"}:
        getattr(measured, name)[:] = change[name]
    if "turn" in change:
        measured.flow[:] = (rotation_field(PLACES) @ np.array([0, -0.02, 0]))[None]
    if "fast" in change:
        measured.motion[10:19] = 0.15
    told = preview(FACTS, measured, choose(measured, 10))
    assert (len(told.advice), told.advice and advice in told.advice[0]) in {(0, ()), (1, True)}, told
    assert bool(told.advice) == bool(advice)
    assert ("instead of 10" in told.text) == (len(choose(measured, 10).frames) < 10)
    assert " from 0:04 of 1920x1080 SDR; detail 0.25" in told.text or "sharpness" in change
