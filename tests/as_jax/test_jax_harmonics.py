# SPDX-License-Identifier: Apache-2.0
"""`clsplat.jax.spherical_harmonics` against the NumPy call, bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from needs import require

from clsplat.errors import InputError
from clsplat.library import harmonics

require("jax")
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402

import clsplat.jax  # noqa: E402

RANDOM = np.random.default_rng(2)
DIRECTIONS = RANDOM.normal(size=(2, 5, 3)).astype(np.float32)
COEFFICIENTS = RANDOM.normal(size=(2, 5, 9, 3)).astype(np.float32)
WEIGHTS = RANDOM.normal(size=(2, 5, 3)).astype(np.float32)
MASKS = np.array([[True, False, True, True, False]] * 2)


@pytest.mark.parametrize("masks", [None, MASKS])
def test_colours_and_gradients_are_those_of_numpy(masks: Any) -> None:
    def loss(directions: Any, coefficients: Any) -> Any:
        return jnp.sum(WEIGHTS * clsplat.jax.spherical_harmonics(2, directions, coefficients, masks))

    expected = harmonics.spherical_harmonics(2, DIRECTIONS, COEFFICIENTS, masks)
    assert np.array_equal(clsplat.jax.spherical_harmonics(2, DIRECTIONS, COEFFICIENTS, masks), expected.colors)
    gradients = jax.jit(jax.grad(loss, (0, 1)))(DIRECTIONS, COEFFICIENTS)
    by_numpy = expected.vjp(WEIGHTS)
    assert np.array_equal(gradients[0], by_numpy["directions"])
    assert np.array_equal(gradients[1], by_numpy["coefficients"])


def test_shapes_are_refused_by_name() -> None:
    with pytest.raises(InputError, match=r"coefficients: got shape \(2, 4, 9, 3\), expected \(2, 5, K, 3\)"):
        clsplat.jax.spherical_harmonics(2, DIRECTIONS, COEFFICIENTS[:, :4])
    with pytest.raises(InputError, match=r"masks: got shape \(5,\), expected \(2, 5\)"):
        clsplat.jax.spherical_harmonics(2, DIRECTIONS, COEFFICIENTS, MASKS[0])
