# SPDX-License-Identifier: Apache-2.0
"""`torch.autograd.gradcheck` and `torch.compile` over `clsplat.torch`."""

from __future__ import annotations

import warnings
from typing import Any

import pytest
from needs import require

require("torch")

import clouds
import torch
from torch import Tensor
from torch.autograd import forward_ad

from clsplat.torch import rasterization

pytestmark = pytest.mark.needs("torch")

NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds")


def wide(degree: int | None) -> tuple[dict[str, Any], tuple[Tensor, ...]]:
    """A few wide, faint Gaussians, whose edges are outside of a small picture: nothing of it is near a threshold."""
    made = clouds.cloud(3, degree=degree, cams=2)
    made["means"] = made["means"] * torch.tensor([0.2, 0.2, 1]).double()
    made["scales"] = 0.2 * made["scales"] + 0.8
    made["opacities"] = 0.2 + 0.4 * made["opacities"]
    made["Ks"][:, 0, 2], made["Ks"][:, 1, 2] = 3, 2.5
    made |= {"width": 6, "height": 5, "backgrounds": torch.full((2, 3), 0.3).double()}
    tensors = tuple(made.pop(name).float().requires_grad_() for name in NAMES)
    return made, tensors


@pytest.mark.parametrize(
    ("degree", "settings"),
    [
        (None, {}),
        pytest.param(None, {"packed": False, "rasterize_mode": "antialiased"}, marks=pytest.mark.slow),
        pytest.param(1, {"render_mode": "RGB+D"}, marks=pytest.mark.slow),
        pytest.param(2, {"render_mode": "RGB+ED"}, marks=pytest.mark.slow),
    ],
)
def test_gradcheck(degree: int | None, settings: dict[str, Any]) -> None:
    """Finite differences of float32: steps of 1e-2 leave 1e-2 of a gradient that is a hundred times the least."""
    made, tensors = wide(degree)

    def images(*given: Tensor) -> tuple[Tensor, Tensor]:
        used = [*given]
        # skew and the last row have no part in an image, nor has the last row of a view matrix
        image, alpha, _ = rasterization(**dict(zip(NAMES, used, strict=True)), **made, **settings)
        return image, alpha

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of float32
        assert torch.autograd.gradcheck(images, tensors, eps=1e-2, atol=2e-2, rtol=2e-2, nondet_tol=0.0, fast_mode=True)


@pytest.mark.slow  # importing the compiler
def test_compiled_code_may_call_it() -> None:
    made, tensors = wide(None)
    made = {**made, **dict(zip(NAMES, tensors, strict=True))}

    def loss(**given: Any) -> Tensor:
        images, alphas, meta = rasterization(**given)
        return (images.square().sum() + alphas.sum()) * 2 + meta["means2d"].sum()

    plain = loss(**made)
    plain.backward()
    expected = made["means"].grad.clone()
    made["means"].grad = None
    compiled = torch.compile(loss, backend="eager")
    for _ in range(2):
        made["means"].grad = None
        found = compiled(**made)
        found.backward()
        assert torch.equal(found, plain)
        assert torch.equal(made["means"].grad, expected)


@pytest.mark.slow  # importing the compiler
@pytest.mark.parametrize("packed", [False, True])
def test_compiled_code_may_look_at_meta_without_gradients(packed: bool) -> None:
    made, tensors = wide(None)
    made = {**made, **dict(zip(NAMES, tensors, strict=True)), "packed": packed}

    def drawn(**given: Any) -> tuple[Tensor, Tensor, Tensor]:
        images, _, meta = rasterization(**given)
        return images * 2, meta["means2d"], meta["radii"]

    with torch.inference_mode():
        expected = drawn(**made)
        compiled = torch.compile(drawn, backend="eager")
        for _ in range(2):
            assert all(map(torch.equal, compiled(**made), expected))


def test_a_tangent_is_refused_and_not_lost() -> None:
    made, tensors = wide(None)
    given = {**made, **{name: tensor.detach() for name, tensor in zip(NAMES, tensors, strict=True)}}
    with forward_ad.dual_level(), pytest.raises(NotImplementedError, match="jvp"):
        rasterization(**{**given, "means": forward_ad.make_dual(given["means"], torch.ones_like(given["means"]))})


def test_a_scaled_loss_that_overflows_is_a_step_left_out() -> None:
    made, tensors = wide(None)
    leaves = [tensor.detach().clone().requires_grad_() for tensor in tensors]
    optimizer, scaler = torch.optim.SGD(leaves, lr=1.0), torch.amp.GradScaler("cpu", init_scale=3e38)
    images, *_ = rasterization(**dict(zip(NAMES, leaves, strict=True)), **made)
    scaler.scale(1e3 * images.sum()).backward()
    scaler.step(optimizer)
    scaler.update()
    assert scaler.get_scale() < 3e38
    assert all(torch.equal(leaf, tensor) for leaf, tensor in zip(leaves, tensors, strict=True))
