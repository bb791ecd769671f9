# SPDX-License-Identifier: Apache-2.0
"""`spherical_harmonics` against gsplat's PyTorch reference, and its errors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from calls import refuses
from compare import assert_close_gradient

from clsplat.device.context import Device
from clsplat.library.harmonics import spherical_harmonics

RNG = np.random.default_rng(5)
DIRECTIONS, COEFFICIENTS = RNG.normal(size=(3, 70, 3)), RNG.normal(size=(3, 70, 25, 3))
BY = RNG.normal(size=(3, 70, 3))


@pytest.mark.needs("gsplat")
@pytest.mark.needs("torch")
@pytest.mark.parametrize("degree", range(5))
def test_gsplat_s_reference_has_the_same(degree: int) -> None:
    torch = pytest.importorskip("torch")
    reference = pytest.importorskip("gsplat.cuda._torch_impl")
    found = spherical_harmonics(degree, DIRECTIONS, COEFFICIENTS)
    directions, coefficients = (torch.tensor(a, requires_grad=True) for a in (DIRECTIONS, COEFFICIENTS))
    colors = reference._spherical_harmonics(degree, directions, coefficients)
    (colors * torch.tensor(BY)).sum().backward()
    np.testing.assert_allclose(found.colors, colors.detach().numpy(), atol=1e-5)
    by = found.vjp(BY)
    assert_close_gradient(by["coefficients"], coefficients.grad.numpy(), 1e-5)
    if degree:
        assert_close_gradient(by["directions"], directions.grad.numpy(), 1e-5)
    else:
        assert not by["directions"].any()


def test_masks(device: Device) -> None:
    masks = RNG.random((3, 70)) < 0.5
    whole = spherical_harmonics(2, DIRECTIONS, COEFFICIENTS[:, :, :9], device=device)
    part = spherical_harmonics(2, DIRECTIONS, COEFFICIENTS[:, :, :9], masks, device=device)
    np.testing.assert_array_equal(part.colors, np.where(masks[..., None], whole.colors, 0))
    by_whole, by_part = whole.vjp(BY), part.vjp(BY)
    for name, values in by_whole.items():
        shown = masks.reshape(3, 70, *[1] * (values.ndim - 2))
        np.testing.assert_array_equal(by_part[name], np.where(shown, values, 0))


def test_no_directions_and_a_single_one(default_device: Device) -> None:
    none = spherical_harmonics(1, np.zeros((0, 3)), np.zeros((0, 4, 3)), device=default_device)
    assert none.colors.shape == (0, 3)
    assert none.vjp(np.zeros((0, 3)))["coefficients"].shape == (0, 4, 3)
    one = spherical_harmonics(3, DIRECTIONS[0, 0], COEFFICIENTS[0, 0], device=default_device)
    assert one.colors.shape == (3,)
    assert one.vjp(BY[0, 0])["coefficients"].shape == (25, 3)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ((5, DIRECTIONS, COEFFICIENTS), "degree is 5, expected a whole number from 0 to 4"),
        ((1.5, DIRECTIONS, COEFFICIENTS), "degree is 1.5, expected a whole number from 0 to 4"),
        ((2, DIRECTIONS, COEFFICIENTS[:, :, :4]), "coefficients: got K = 4, expected 9 or more for degree 2"),
        ((1, DIRECTIONS[:2], COEFFICIENTS), r"coefficients: got shape \(3, 70, 25, 3\), expected \(2, 70, K, 3\)"),
        ((1, DIRECTIONS[..., :2], COEFFICIENTS), r"directions: got shape \(3, 70, 2\), expected \(3, 70, 3\)"),
        ((1, np.full((1, 3), np.inf), np.zeros((1, 4, 3))), r"directions: \[0, 0\] is inf, expected finite numbers"),
        ((1, DIRECTIONS, COEFFICIENTS, np.ones(70)), r"masks: got shape \(70,\), expected \(3, 70\)"),
    ],
)
def test_errors_name_the_argument(arguments: tuple[Any, ...], told: str) -> None:
    refuses(told, spherical_harmonics, *arguments)
