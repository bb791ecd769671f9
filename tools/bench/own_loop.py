#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Compare a training loop on `clsplat.torch`, as in gsplat's documentation, with `clsplat train` on a scene.

python tools/bench/own_loop.py SCENES/fox --resolution 400 --steps 2000 --strategy default
python tools/bench/own_loop.py SCENES/fox --resolution 400 --steps 2000 --strategy mcmc --steps-scaler 0.0667

The loop follows gsplat's `simple_trainer`: its parameters, learning rates, schedules, loss and calls of a strategy.
With `from gsplat import ...` instead of the import of `clsplat.torch` it is a program for CUDA. Prints the mean PSNR of
the held-out views, the number of Gaussians and the seconds of both trainings. The exit status is 1 if the loop's PSNR
is more than --bound below that of `clsplat train`.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d

from clsplat import load_scene
from clsplat.api import train
from clsplat.config.training import TrainConfig
from clsplat.device.selection import open_device
from clsplat.evaluation.held_out import EvaluatedModel, evaluate
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene, View
from clsplat.scenes.start.initialise import from_scene
from clsplat.torch import DefaultStrategy, MCMCStrategy, rasterization

MAX_STEPS = 30_000
"""Steps for which the defaults of gsplat and clsplat are meant, and over which the rate of the means falls."""
SH_DEGREE, SH_DEGREE_EVERY, SSIM_WEIGHT = 3, 1000, 0.2
OPACITY_WEIGHT = SCALE_WEIGHT = 0.01
"""gsplat's settings for MCMC, which also start from other sizes and opacities."""
Params: TypeAlias = torch.nn.ParameterDict


def main(arguments: list[str]) -> int:
    """Print a line for each training. Returns 1 if the loop is below the bound."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--resolution", type=int, default=0)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--strategy", choices=("default", "mcmc"), default="default")
    parser.add_argument("--most", type=int, default=50_000, help="Gaussians that mcmc grows to")
    parser.add_argument("--steps-scaler", type=float, default=1.0, help="of all of gsplat's settings that are steps")
    parser.add_argument("--init-scale", type=float, help="of a point's distance to its neighbours; mcmc: 0.1, else 1")
    parser.add_argument("--init-opacity", type=float, help="mcmc: 0.5, else 0.1")
    parser.add_argument("--packed", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bound", type=float, default=0.3, help="dB")
    parser.add_argument("--alone", action="store_true", help="no `clsplat train` to compare with")
    given = parser.parse_args(arguments)
    preset = (0.1, 0.5) if given.strategy == "mcmc" else (1.0, 0.1)
    given.init_scale, given.init_opacity = given.init_scale or preset[0], given.init_opacity or preset[1]
    scene = load_scene(given.scene, resolution=given.resolution)
    began = time.perf_counter()
    params = own_loop(scene, given)
    own = psnr(lambda view: picture(params, view, SH_DEGREE, packed=given.packed)[0][0], scene)
    report("own loop", own, len(params["means"]), began)
    if given.alone:
        return 0
    device, config = open_device(), TrainConfig(iterations=given.steps, resolution=given.resolution, seed=given.seed)
    began = time.perf_counter()
    model = train(scene, config, device=device)
    renderer = Renderer(device)
    other = psnr(lambda view: torch.from_numpy(renderer.render(model, view.camera).image), scene)
    report("clsplat train", other, len(model.means), began)
    print(f"difference {own - other:+.2f} dB")
    return int(own < other - given.bound)


def report(title: str, score: float, count: int, began: float) -> None:
    """Print a training's line. began: time.perf_counter() at its start."""
    print(f"{title}: {score:.2f} dB, {count:,} Gaussians, {time.perf_counter() - began:.0f} s", flush=True)


def psnr(render: Callable[[View], Tensor], scene: Scene) -> float:
    """Mean PSNR of the held-out views in dB. render: draws a view, (H, W, 3)."""

    def image(view: View) -> Any:
        with torch.no_grad():
            return render(view).clamp(0, 1).numpy()

    found = evaluate(image, scene.test_views, np.zeros(3), model=EvaluatedModel(None, 0, None))
    return float(found["mean"]["psnr"])


def own_loop(scene: Scene, given: argparse.Namespace) -> Params:
    """Train a model of the scene; returns its parameters."""
    torch.manual_seed(given.seed)
    params = initial(scene, given)
    optimizers = optimizers_of(params, scene.extent)
    mcmc = given.strategy == "mcmc"
    strategy = strategy_of(given)
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state() if mcmc else strategy.initialize_state(scene_scale=scene.extent)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizers["means"], gamma=0.01 ** (1 / scaled(MAX_STEPS, given)))
    views = scene.train_views
    photographs = [torch.from_numpy(view.load()[:, :, :3]) for view in views]
    order: list[int] = []
    for step in range(given.steps):
        if step % len(views) == 0:
            order = torch.randperm(len(views)).tolist()
        index = order[step % len(views)]
        degree = min(step // scaled(SH_DEGREE_EVERY, given), SH_DEGREE)
        images, _, info = picture(params, views[index], degree, packed=given.packed)
        strategy.step_pre_backward(params, optimizers, state, step, info)
        target = photographs[index]
        l1 = (images[0] - target).abs().mean()
        loss = (1 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * (1 - ssim(images[0], target))
        if mcmc:
            loss = loss + OPACITY_WEIGHT * torch.sigmoid(params["opacities"]).mean()
            loss = loss + SCALE_WEIGHT * torch.exp(params["scales"]).mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        schedule.step()
        if mcmc:
            strategy.step_post_backward(params, optimizers, state, step, info, lr=schedule.get_last_lr()[0])
        else:
            strategy.step_post_backward(params, optimizers, state, step, info, packed=given.packed)
        if step % 100 == 0:
            print(f"step {step}: loss {loss.item():.4f}, {len(params['means']):,} Gaussians", flush=True)
    return params


def scaled(steps: int, given: argparse.Namespace) -> int:
    """A number of steps among gsplat's settings, scaled to this training by --steps-scaler."""
    return max(1, int(steps * given.steps_scaler))


def strategy_of(given: argparse.Namespace) -> Any:
    """gsplat's strategy, with its settings."""
    strategy: Any = MCMCStrategy(cap_max=given.most) if given.strategy == "mcmc" else DefaultStrategy()
    for name in ("refine_start_iter", "refine_stop_iter", "refine_every", "reset_every"):
        if hasattr(strategy, name):
            setattr(strategy, name, scaled(getattr(strategy, name), given))
    return strategy


def initial(scene: Scene, given: argparse.Namespace) -> Params:
    """gsplat's parameters at the scene's points: scales as logarithms, opacities as logits, SH in two parts."""
    model = from_scene(scene, TrainConfig.random_points, np.random.default_rng(given.seed))
    count = len(model.means)
    values = {
        "means": torch.from_numpy(model.means + np.asarray(scene.origin, np.float32)),
        "scales": torch.from_numpy(model.log_scales) + math.log(given.init_scale),
        "quats": torch.rand(count, 4),
        "opacities": torch.logit(torch.full((count,), given.init_opacity)),
        "sh0": torch.from_numpy(model.sh[:, :1]),
        "shN": torch.zeros(count, (SH_DEGREE + 1) ** 2 - 1, 3),
    }
    return Params({name: torch.nn.Parameter(value.clone()) for name, value in values.items()})


def optimizers_of(params: Params, extent: float) -> dict[str, torch.optim.Optimizer]:
    """An Adam for each parameter, with gsplat's rates."""
    rates = {
        "means": 1.6e-4 * extent,
        "scales": 5e-3,
        "quats": 1e-3,
        "opacities": 5e-2,
        "sh0": 2.5e-3,
        "shN": 2.5e-3 / 20,
    }
    return {
        name: torch.optim.Adam([{"params": params[name], "lr": rate, "name": name}], eps=1e-15)
        for name, rate in rates.items()
    }


def picture(params: Params, view: View, degree: int, *, packed: bool) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render a view of the model: images (1, H, W, 3), alphas, and the dict that a strategy reads. degree: of SH."""
    camera = view.camera
    pose = torch.eye(4)
    pose[:3, :3] = torch.from_numpy(camera.rotation)
    pose[:3, 3] = torch.from_numpy(camera.translation)
    lens = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    return rasterization(
        means=params["means"],
        quats=params["quats"],
        scales=torch.exp(params["scales"]),
        opacities=torch.sigmoid(params["opacities"]),
        colors=torch.cat([params["sh0"], params["shN"]], 1),
        viewmats=pose[None],
        Ks=lens[None],
        width=camera.width,
        height=camera.height,
        sh_degree=degree,
        packed=packed,
    )


def ssim(image: Tensor, target: Tensor, side: int = 11, sigma: float = 1.5) -> Tensor:
    """Mean SSIM of two images (H, W, 3) in [0, 1] (Wang et al. 2004)."""
    offsets = torch.arange(side) - side // 2
    weights = torch.exp(-(offsets**2) / (2 * sigma**2))
    weights = weights / weights.sum()
    stack = torch.stack([image, target, image * image, target * target, image * target])
    planes = stack.permute(0, 3, 1, 2).reshape(15, 1, *image.shape[:2])
    planes = conv2d(conv2d(planes, weights.reshape(1, 1, 1, -1)), weights.reshape(1, 1, -1, 1))
    mean, other, square, other_square, product = planes.reshape(5, 3, *planes.shape[2:])
    first = (2 * mean * other + 0.01**2) / (mean**2 + other**2 + 0.01**2)
    spread = square - mean**2 + other_square - other**2
    return (first * (2 * (product - mean * other) + 0.03**2) / (spread + 0.03**2)).mean()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
