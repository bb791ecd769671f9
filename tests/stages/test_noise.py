# SPDX-License-Identifier: Apache-2.0
"""noise.cl against its float64 twin, its bits in every shape, the statistics of its numbers; penalties, (91)."""

from __future__ import annotations

import numpy as np
import pytest
import scenes
from compare import assert_same_bits
from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray, upload
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS, Gaussians
from clsplat.layouts.columns import READBACK
from clsplat.optimisation.step_noise import Exploration, step_key
from clsplat.reference.noise import normal_numbers, penalty, penalty_grad
from clsplat.stages.device_gaussians import upload_gaussians
from clsplat.stages.noise import NOISE_OPACITY_RANGE, noise

LOUD = Exploration(amount=40.0, key=step_key(7, 123))


def counts(device: Device) -> DeviceArray:
    return upload(device, np.zeros(len(READBACK), np.uint32))


def faint(count: int) -> Gaussians:
    """Gaussians about the opacity of the dead, with means at the origin, so that no digits of the noise are lost."""
    gaussians, _ = scenes.random_cloud(count, 5, 70, 50, degree=0)
    rng = np.random.default_rng(count)
    opacities = rng.uniform(1e-4, 0.2, count)
    gaussians.opacity_logits[:] = np.log(opacities / (1 - opacities))
    gaussians.means[:] = 0.0
    return gaussians


def moved(device: Device, gaussians: Gaussians, explore: Exploration, first_row: int = 0) -> NDArray[np.float32]:
    held = upload_gaussians(device, gaussians)
    noise(device, explore, held, first_row, counts(device))
    for group in PARAMETER_GROUPS:
        if group not in ("means", "sh_dc", "sh_rest"):
            assert_same_bits(held[group].get(), getattr(gaussians, PARAMETER_GROUPS[group].field), group)
    return held["means"].get()


@pytest.mark.smoke
def test_numbers_are_nearly_normal() -> None:
    """Mean 0, variance 1, fourth moment 3 - 6/(5 * 8); no correlation between coordinates, rows and steps."""
    rows = np.arange(200_000)
    numbers = [normal_numbers(step_key(3, step), rows) for step in (1, 2)]
    values, of_error = numbers[0], 5 / np.sqrt(len(rows))
    assert np.abs(values.mean(axis=0)).max() < of_error
    assert np.abs((values**2).mean(axis=0) - 1).max() < of_error * np.sqrt(2)
    assert np.abs((values**4).mean(axis=0) - 2.85).max() < of_error * np.sqrt(90)
    assert np.abs(values).max() < np.sqrt(24)
    products = [values[:, 0] * values[:, 1], values[:, 1] * values[:, 2], values[:, 0] * values[:, 2]]
    products += [(values[1:] * values[:-1]).ravel(), (numbers[0] * numbers[1]).ravel()]
    for product in products:
        assert abs(product.mean()) < of_error


def test_pieces_and_steps(device: Device) -> None:
    """A piece of the rows has the bits that these have in the whole; another step has others."""
    gaussians = faint(90)
    whole = moved(device, gaussians, LOUD)
    part = Gaussians(*(array[30:] for array in gaussians.arrays().values()))
    assert_same_bits(moved(device, part, LOUD, 30), whole[30:], "means")
    other = moved(device, gaussians, Exploration(amount=40.0, key=step_key(7, 124)))
    assert (other != whole).any(axis=1).mean() > 0.7


def test_what_stays(device: Device) -> None:
    """The opaque, what has no rotation or a size beyond all bounds, and everything after a pass that has stopped."""
    gaussians = faint(40)
    gaussians.opacity_logits[:] = -6
    gaussians.means[:] = 1.0
    opaque = LOUD.dead + 1.01 * NOISE_OPACITY_RANGE
    gaussians.opacity_logits[0] = np.log(opaque / (1 - opaque))
    gaussians.quaternions[1] = 0
    gaussians.log_scales[2] = 80
    gaussians.log_scales[3, 0] = np.inf
    gaussians.opacity_logits[4] = np.nan
    gaussians.quaternions[5] = np.nan
    got = moved(device, gaussians, LOUD)
    assert_same_bits(got[:6], gaussians.means[:6], "means")
    assert (got[6:] != 1).any(axis=1).all()
    held, stopped = upload_gaussians(device, gaussians), counts(device)
    values = stopped.get()
    values[READBACK.index("STOPPED")] = 1
    stopped.set(values)
    noise(device, LOUD, held, 0, stopped)
    assert_same_bits(held["means"].get(), gaussians.means, "means")


def test_a_step_without_noise_launches_nothing(default_device: Device) -> None:
    device, gaussians, stages = default_device.with_shape(), faint(10), []
    for explore in (Exploration(opacity=0.3, scale=0.7), LOUD):
        held, readback = upload_gaussians(device, gaussians), counts(device)
        with device.recorder.recording(wait=True) as recorded:
            noise(device, explore, held, 0, readback)
        stages.append({name: record.launches for name, record in recorded.items()})
    assert stages == [{}, {"noise": 1}]


def test_the_twins_penalty_by_finite_differences() -> None:
    explore, rng = Exploration(opacity=0.3, scale=0.7), np.random.default_rng(1)
    scales, logits, step = rng.normal(-2, 1, (9, 3)), rng.normal(0, 3, 9), 1e-6
    by_scales, by_logits = penalty_grad(explore, scales, logits)
    for index in np.ndindex(scales.shape):
        change = np.zeros(scales.shape)
        change[index] = step
        difference = penalty(explore, scales + change, logits) - penalty(explore, scales - change, logits)
        assert difference / (2 * step) == pytest.approx(by_scales[index], rel=1e-6, abs=1e-9)
    for row in range(len(logits)):
        change = np.zeros(len(logits))
        change[row] = step
        difference = penalty(explore, scales, logits + change) - penalty(explore, scales, logits - change)
        assert difference / (2 * step) == pytest.approx(by_logits[row], rel=1e-6, abs=1e-9)
