# SPDX-License-Identifier: Apache-2.0
"""gsplat's own density control over `clsplat.torch.rasterization`: both strategies change a small model."""

from __future__ import annotations

from typing import Any

import pytest
from needs import require

require("torch")
require("gsplat")

import clouds
import torch

from clsplat.torch import DefaultStrategy, MCMCStrategy, rasterization

pytestmark = [pytest.mark.needs("torch"), pytest.mark.needs("gsplat")]


def model(count: int) -> tuple[torch.nn.ParameterDict, dict[str, torch.optim.Optimizer], dict[str, Any]]:
    """Parameters as gsplat's examples store them, an optimizer for each, and the cameras."""
    made = clouds.cloud(count, cams=1)
    floats = {name: value.float() for name, value in made.items() if isinstance(value, torch.Tensor)}
    params = torch.nn.ParameterDict(
        {
            "means": torch.nn.Parameter(floats["means"]),
            "scales": torch.nn.Parameter(floats["scales"].log()),
            "quats": torch.nn.Parameter(floats["quats"]),
            "opacities": torch.nn.Parameter(floats["opacities"].logit()),
            "colors": torch.nn.Parameter(floats["colors"]),
        }
    )
    rates = {"means": 1e-3, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "colors": 1e-2}
    optimisers: dict[str, torch.optim.Optimizer] = {
        name: torch.optim.Adam([{"params": params[name], "lr": rate, "name": name}], eps=1e-15)
        for name, rate in rates.items()
    }
    return params, optimisers, {"viewmats": floats["viewmats"], "Ks": floats["Ks"], "width": 37, "height": 29}


def drawn(params: torch.nn.ParameterDict, **how: Any) -> Any:
    values = {"scales": torch.exp(params["scales"]), "opacities": torch.sigmoid(params["opacities"])}
    return rasterization(**{name: params[name] for name in ("means", "quats", "colors")}, **values, **how)


def run(strategy: Any, packed: bool, steps: int, **extra: Any) -> tuple[list[int], list[float]]:
    """Numbers of Gaussians and losses of a short training, written as in gsplat's documentation."""
    torch.manual_seed(0)
    params, optimisers, cameras = model(30)
    target = rasterization(**{**clouds.cloud(30, seed=5), **cameras})[0].float()
    strategy.check_sanity(params, optimisers)
    state = strategy.initialize_state()
    counts, losses = [], []
    for step in range(steps):
        images, _, info = drawn(params, packed=packed, absgrad=getattr(strategy, "absgrad", False), **cameras)
        strategy.step_pre_backward(params, optimisers, state, step, info)
        loss = (images - target).abs().mean()
        loss.backward()
        for optimiser in optimisers.values():
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
        if extra:
            strategy.step_post_backward(params, optimisers, state, step, info, **extra)
        else:
            strategy.step_post_backward(params, optimisers, state, step, info, packed=packed)
        counts.append(len(params["means"]))
        losses.append(loss.item())
    return counts, losses


@pytest.mark.parametrize(
    ("packed", "absgrad"),
    [
        (True, False),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in ((False, False), (False, True), (True, True))),
    ],
)
def test_the_default_strategy_clones_splits_and_prunes(packed: bool, absgrad: bool) -> None:
    steps = {"refine_start_iter": 5, "refine_every": 5, "reset_every": 15, "refine_scale2d_stop_iter": 20}
    strategy = DefaultStrategy(grow_grad2d=1e-4, absgrad=absgrad, **steps)
    counts, losses = run(strategy, packed, 24)
    assert len(set(counts)) > 2
    assert max(counts) > 30
    assert losses[10] < losses[0]


@pytest.mark.parametrize("packed", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_mcmc_strategy_moves_and_adds(packed: bool) -> None:
    strategy = MCMCStrategy(cap_max=40, refine_start_iter=5, refine_every=5, min_opacity=0.3, noise_lr=1.0)
    counts, losses = run(strategy, packed, 40, lr=1e-3)
    assert counts[0] == 30
    assert counts[-1] > 32
    assert losses[-1] < losses[0]


def test_the_strategies_are_gsplats_own() -> None:
    gsplat = pytest.importorskip("gsplat")
    assert DefaultStrategy is gsplat.DefaultStrategy
    assert MCMCStrategy is gsplat.MCMCStrategy


def test_gaussians_that_are_added_share_the_picture_of_those_that_they_join() -> None:
    """Equation (9) keeps the picture of a Gaussian, to about 0.02 of its opacity, when others come to its place."""
    torch.manual_seed(0)
    params, optimisers, cameras = model(30)

    def picture() -> torch.Tensor:
        with torch.no_grad():
            return drawn(params, **cameras, eps2d=0.0)[0]

    before, strategy = picture(), MCMCStrategy(cap_max=45, min_opacity=0.0)
    operations = pytest.importorskip("gsplat.strategy.ops")
    binoms = strategy.initialize_state()["binoms"]
    operations.sample_add(params, optimisers, {}, 15, binoms, min_opacity=0.0)
    assert len(params["means"]) == 45
    change = (picture() - before).abs()
    assert change.mean() < 0.01
    assert change.max() < 0.1
