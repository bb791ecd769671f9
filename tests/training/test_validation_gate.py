# SPDX-License-Identifier: Apache-2.0
"""The gate on refined cameras: when it measures, what it decides, and how held-out poses are taken along."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from calls import refuses
from numpy.typing import NDArray
from scenes import tilted_camera

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.config.presets import scheduled
from clsplat.config.training import DensityConfig, TrainConfig
from clsplat.training.cameras.validation_gate import CameraGate, Drift, drift, steps_of

CONFIG = TrainConfig(iterations=1000, refine_poses=True, refine_gate=0.5, density=DensityConfig(every=0))
EXTENT = 3.0


def cameras(positions: Float64, seed: int = 0) -> list[Camera]:
    """Cameras at positions (n, 3), turned at random."""
    rng, still = np.random.default_rng(seed), np.zeros(3)
    turned = [tilted_camera(8, 8).moved(np.append(rng.normal(size=3), still)) for _ in positions]
    pairs = zip(turned, positions, strict=True)
    return [camera.posed(camera.rotation, -camera.rotation @ position) for camera, position in pairs]


def some_positions(count: int) -> Float64:
    places: Float64 = np.random.default_rng(4).normal(size=(count, 3))
    return places


def some_drift() -> Drift:
    rotation = tilted_camera(8, 8).moved(np.array([0.05, -0.1, 0.02, 0, 0, 0])).rotation
    return Drift(1.03, rotation, np.array([0.2, -0.1, 0.4]))


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        (TrainConfig(iterations=7000), (500, 700, 1400, 2100, 2800, 3000, 4200, 4900, 5600, 6000, 7000)),
        (scheduled("short", 7000), (500, 700, 1400, 2100, 2800, 3000, 4200, 4900, 5600, 6300, 7000)),
        (TrainConfig(), (500, *range(3000, 30_001, 3000))),
        (TrainConfig(iterations=2550), (255, 510, 700, 1000, 1200, 1500, 1700, 2000, 2200, 2500)),
        (TrainConfig(iterations=300), tuple(range(30, 301, 30))),
        (TrainConfig(iterations=3000, background="white"), (300, 500, 1500, 1800, 2100, 2400, 2700, 3000)),
        (TrainConfig(iterations=5), (0, 1, 2, 3, 4, 5)),
    ],
)
def test_measurements_come_before_what_disturbs_them(config: TrainConfig, expected: tuple[int, ...]) -> None:
    """Not shortly after a split or an opacity reset, but before it."""
    assert steps_of(config) == expected


def test_a_camera_taken_along_sees_the_same() -> None:
    camera, world = cameras(some_positions(1))[0], some_positions(5)
    made = some_drift()
    drifted = made.scale * world @ made.rotation.T + made.shift
    along = made.taken_along(camera)
    before, after = (
        points @ each.rotation.T + each.translation for points, each in ((world, camera), (drifted, along))
    )
    np.testing.assert_allclose(after, made.scale * before, rtol=0, atol=1e-12)  # a few float64 roundings of about 1


@pytest.mark.parametrize(
    "positions",
    [some_positions(3), some_positions(20), some_positions(20) * [1, 0, 0], np.zeros((6, 3)), 1e6 + some_positions(9)],
    ids=["three", "many", "on a line", "in a point", "far away"],
)
def test_a_drift_is_found(positions: Float64) -> None:
    """Exactly, where all poses drift alike."""
    given, made = cameras(positions), some_drift()
    found = drift(given, [made.taken_along(camera) for camera in given], EXTENT)
    np.testing.assert_allclose(
        found.rotation, made.rotation, rtol=0, atol=1e-8
    )  # positions of 1e6 are rounded by 1e-10
    for camera in given:
        np.testing.assert_allclose(found.taken_along(camera).position, made.taken_along(camera).position, rtol=1e-9)


def test_no_drift() -> None:
    given = cameras(some_positions(7))
    found = drift(given, given, EXTENT)
    assert found.scale == pytest.approx(1, abs=1e-14)
    np.testing.assert_allclose(found.rotation, np.eye(3), rtol=0, atol=1e-14)
    np.testing.assert_allclose(found.shift, 0, rtol=0, atol=1e-13)


def test_few_that_go_far_take_nothing_along() -> None:
    """Two of twenty go 40 degrees and a third of the extent: with equal weights that would be 4 degrees of drift."""
    given, rng = cameras(some_positions(20)), np.random.default_rng(5)
    noise = np.append(1e-3 * rng.normal(size=3), 1e-3 * EXTENT * rng.normal(size=3))
    refined = [camera.moved(noise * rng.normal(size=6)) for camera in given]
    for index in (3, 11):
        refined[index] = given[index].moved(np.array([0.7, 0, 0, 1, 0, 0]))
    found = drift(given, refined, EXTENT)
    angle = np.degrees(np.arccos(np.clip((np.trace(found.rotation) - 1) / 2, -1, 1)))
    assert angle < 0.2
    assert np.linalg.norm(found.taken_along(given[0]).position - given[0].position) < 0.01 * EXTENT


def arrays(value: float) -> dict[str, NDArray[Any]]:
    return {"poses/rotations": np.full((2, 3, 3), value), "poses/visits": np.full(2, value).astype(np.int64)}


def judged(values: list[float], config: TrainConfig = CONFIG) -> tuple[CameraGate, list[str]]:
    """The gate after these measurements, each with cameras of the number of the measurement, and its warnings."""
    gate, said = CameraGate(config, 2), []
    for index, (step, value) in enumerate(zip(steps_of(config), values, strict=False)):
        assert gate.is_due(step)
        back, text = gate.validate(step, value, arrays(index))
        assert (back is not None) == (gate.ended == step)
        if back is not None:
            best = int(np.argmax(values[: index + 1]))
            np.testing.assert_array_equal(back["poses/rotations"], arrays(best)["poses/rotations"])
        said += [text] if text else []
        assert not gate.is_due(step)
    return gate, said


@pytest.mark.parametrize(
    ("values", "ended"),
    [
        ([20, 21, 22, 23, 24], None),
        ([20, 19.6, 19.6, 19.6], None),
        ([20, 19.4, 19.6, 19.4, 19.6], None),
        ([20, 19.4, 19.4], 300),
        ([20, 24, 23, 23.6, 23.4, 23.4], 600),
        ([20, 19, 18, 17, 25, 24, 23], 300),
        ([*range(20, 28), 20, 20], None),
    ],
    ids=["rises", "in bounds", "once", "twice", "from the best", "ends once", "no step left"],
)
def test_the_rule(values: list[float], ended: int | None) -> None:
    gate, said = judged(values)
    assert gate.ended == ended
    assert len(said) == (ended is not None or values[-1] == 20)
    assert [value for _, value in gate.measured] == values


def test_the_warning_has_the_figures_and_a_way_on() -> None:
    gate, said = judged([25.126, 24, 23.5, 28])
    text = (
        "--refine-poses: held-out views had 25.13 dB at step 100, but 24.00 and 23.50 dB at steps 200 and 300: the "
        "cameras of step 100 are restored, and refinement ends; try a smaller --pose-reach, or train without "
        "--refine-poses"
    )
    assert said == [text]
    assert gate.record()["best"] == 100
    assert gate.record()["ended"] == 300
    lenses = replace(CONFIG, refine_poses=False, refine_lenses=True)
    assert judged([25, 24, 23], lenses)[1][0].endswith("try a smaller --lens-reach, or train without --refine-lenses")
    late = judged([*[25] * 8, 24, 24])[1]
    assert "as no step is left to train with others" in late[0]


def test_the_bound_is_a_setting() -> None:
    values: list[float] = [20, 19, 19, 19]
    assert judged(values, replace(CONFIG, refine_gate=2.0))[0].ended is None
    for config, held_out in (
        (replace(CONFIG, refine_gate=0.0), 2),
        (CONFIG, 0),
        (replace(CONFIG, refine_poses=False), 2),
    ):
        gate = CameraGate(config, held_out)
        assert not any(gate.is_due(step) for step in range(1001))
        assert not gate.arrays()
    for value in (-1.0, float("nan"), float("inf")):
        refuses("--refine-gate", replace(CONFIG, refine_gate=value).check)


@pytest.mark.parametrize("values", [[], [20.0], [20, 19.4], [20, 19.4, 19.4], [20, 19.4, 19.4, 21]])
def test_a_checkpoint_has_all_of_it(values: list[float]) -> None:
    gate, _ = judged(values)
    again = CameraGate(CONFIG, 2)
    again.load({name.removeprefix("gate/"): array for name, array in gate.arrays().items()}, arrays(7))
    assert (again.measured, again.ended) == (gate.measured, gate.ended)
    assert again.arrays().keys() == gate.arrays().keys()
    for step, value in zip(steps_of(CONFIG)[len(values) :], (19, 19, 30), strict=False):
        mine, theirs = gate.validate(step, value, arrays(9)), again.validate(step, value, arrays(9))
        assert mine[1] == theirs[1]
        assert (mine[0] is None) == (theirs[0] is None)
        for name, array in (mine[0] or {}).items():
            np.testing.assert_array_equal((theirs[0] or {})[name], array)


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("measured", np.zeros((0, 2)), "expected finite steps and dB"),
        ("measured", np.full((1, 2), np.nan), "expected finite steps and dB"),
        ("ended", np.zeros(2, np.int64), "has no gate/ended of shape"),
        ("poses/rotations", np.zeros((3, 3, 3)), "has no gate/poses/rotations of shape"),
    ],
)
def test_a_damaged_checkpoint_is_told(name: str, value: NDArray[Any], text: str) -> None:
    good = {key.removeprefix("gate/"): array for key, array in judged([20.0])[0].arrays().items()}
    refuses(text, CameraGate(CONFIG, 2).load, {**good, name: value}, arrays(7), error=ValueError)
