# SPDX-License-Identifier: Apache-2.0
"""The parts of `clsplat.torch` by themselves, against float64: covariances, relocation, Adam of rows, harmonics,
projection, tiles and pixels."""

from __future__ import annotations

import math
from typing import Any

import pytest
from needs import require

require("torch")

import clouds
import dense
import torch
from torch import Tensor

from clsplat.errors import InputError
from clsplat.torch import (
    SelectiveAdam,
    compute_relocation,
    quat_scale_to_covar_preci,
)

pytestmark = pytest.mark.needs("torch")


def some(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_covariances_and_precisions() -> None:
    quats, scales = some(2, 5, 4), some(2, 5, 3, seed=1).exp()
    covars, precis = quat_scale_to_covar_preci(quats, scales)
    assert torch.allclose(covars, dense.covariances(quats, scales))
    assert torch.allclose(covars @ precis, torch.eye(3).double().expand(2, 5, 3, 3), atol=1e-9)
    upper, upper_precis = quat_scale_to_covar_preci(quats, scales, triu=True)
    rows, columns = torch.triu_indices(3, 3)
    assert torch.equal(upper, covars[..., rows, columns])
    assert torch.equal(upper_precis, precis[..., rows, columns])
    assert quat_scale_to_covar_preci(quats, scales, compute_preci=False)[1] is None
    assert quat_scale_to_covar_preci(quats, scales, compute_covar=False)[0] is None
    inputs = (quats[:1, :2].requires_grad_(), scales[:1, :2].requires_grad_())
    assert torch.autograd.gradcheck(quat_scale_to_covar_preci, inputs)
    with pytest.raises(InputError, match=r"scales is float64 \(2, 5\), expected a tensor \(2, 5, 3\)"):
        quat_scale_to_covar_preci(quats, scales[..., 0])


@pytest.mark.needs("gsplat")
@pytest.mark.parametrize("triu", [False, True])
def test_covariances_are_gsplats(triu: bool) -> None:
    reference = pytest.importorskip("gsplat.cuda._torch_impl")
    quats, scales = some(7, 4), some(7, 3, seed=1).exp()
    for expected, found in zip(
        reference._quat_scale_to_covar_preci(quats, scales, triu=triu),
        quat_scale_to_covar_preci(quats, scales, triu=triu),
        strict=True,
    ):
        assert torch.allclose(found, expected, rtol=1e-12, atol=1e-12)


def binomials(most: int = 51) -> Tensor:
    return torch.tensor([[float(math.comb(n, k)) for k in range(most)] for n in range(most)])


def test_relocation_is_equation_9() -> None:
    """Its double sum, term by term; one that shares its place with no other stays as it is."""
    opacities, ratios = torch.tensor([0.1, 0.5, 0.9, 0.999]), torch.tensor([1, 2, 9, 60])
    scales = some(4, 3).exp().float()
    new_opacities, new_scales = compute_relocation(opacities, scales, ratios, binomials())
    assert ratios.tolist() == [1, 2, 9, 60]
    assert torch.allclose(new_opacities[0], opacities[0])
    assert torch.allclose(new_scales[0], scales[0])
    for row in range(4):
        share, old = min(int(ratios[row]), 51), float(opacities[row])
        new = 1 - (1 - old) ** (1 / share)
        total = sum(
            math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * new ** (k + 1)
            for i in range(1, share + 1)
            for k in range(i)
        )
        assert float(new_opacities[row]) == pytest.approx(new, rel=1e-6)
        # binoms are float32, and the sum has terms a hundred times itself where 51 share the place of one at 0.999
        assert torch.allclose(new_scales[row], old / total * scales[row], rtol=1e-4)


def test_relocation_names_its_arguments() -> None:
    good: dict[str, Any] = {"opacities": torch.ones(2) / 2, "scales": torch.ones(2, 3), "ratios": torch.ones(2)}
    for name, value in (("scales", torch.ones(2)), ("ratios", torch.ones(3)), ("opacities", torch.full((2,), math.nan))):
        with pytest.raises(InputError, match=name):
            compute_relocation(**{**good, name: value}, binoms=binomials(4))
    with pytest.raises(InputError, match="binoms"):
        compute_relocation(**good, binoms=torch.ones(3, 4))


def test_adam_of_rows() -> None:
    """Rows in view have Adam's step without bias correction; the others and their moments stay."""
    start, gradients = some(6, 2), [some(6, 2, seed=seed) for seed in (1, 2, 3)]
    seen = [torch.tensor(row) for row in ([1, 1, 0, 0, 1, 0], [1, 0, 1, 0, 1, 0], [0, 0, 0, 0, 1, 0])]
    parameter = torch.nn.Parameter(start.clone())
    optimiser = SelectiveAdam([{"params": [parameter], "lr": 0.1, "name": "x"}], eps=1e-8, betas=(0.9, 0.99))
    for gradient, mask in zip(gradients, seen, strict=True):
        parameter.grad = gradient.clone()
        optimiser.step(visibility=mask.bool())
    for row in range(6):
        value, first, second = start[row].clone(), torch.zeros(2).double(), torch.zeros(2).double()
        for gradient, mask in zip(gradients, seen, strict=True):
            if mask[row]:
                first = 0.9 * first + 0.1 * gradient[row]
                second = 0.99 * second + 0.01 * gradient[row] ** 2
                value -= 0.1 * first / (second.sqrt() + 1e-8)
        assert torch.allclose(parameter[row], value, rtol=1e-12)
        assert torch.allclose(optimiser.state[parameter]["exp_avg_sq"][row], second)
    parameter.grad = torch.sparse_coo_tensor(torch.tensor([[0, 0]]), some(2, 2), (6, 2)).double()
    optimiser.step(torch.tensor([1.0, 1, 1, 1, 1, 1]))
    with pytest.raises(InputError, match=r"visibility is \(5,\), expected 6 numbers"):
        optimiser.step(torch.ones(5))


def test_adam_of_rows_takes_one_tensor_a_group() -> None:
    tensors = [torch.nn.Parameter(torch.zeros(2)), torch.nn.Parameter(torch.zeros(2))]
    with pytest.raises(InputError, match="params is a group of 2 tensors"):
        SelectiveAdam(tensors, eps=1e-8, betas=(0.9, 0.999)).step(torch.ones(2))
