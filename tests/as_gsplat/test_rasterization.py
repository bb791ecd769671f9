# SPDX-License-Identifier: Apache-2.0
"""`clsplat.torch.rasterization` against the dense float64 oracle of tests/support/dense.py: images and gradients."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Collection, Sequence
from itertools import product
from typing import Any

import pytest
from needs import require

require("torch")

import clouds
import dense
import torch
from torch import Tensor

from clsplat.device.context import Device
from clsplat.torch import rasterization

pytestmark = pytest.mark.needs("torch")

MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
TOLERANCE = 1e-5
"""Of pixels that no threshold is near, and of depths relative to the largest."""
GRADIENT = 1e-4
"""Norm of a gradient's error, relative to the gradient's."""


def drawn(like: Tensor, seed: int) -> Tensor:
    """Numbers to multiply an image with, so that its sum has a gradient everywhere."""
    return torch.randn(like.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def leaves(arguments: dict[str, Any], kind: torch.dtype) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Arguments with tensors of a kind that take gradients, and these."""
    made = {
        name: value.to(kind, copy=True).requires_grad_() if isinstance(value, Tensor) else value
        for name, value in arguments.items()
    }
    return made, {name: value for name, value in made.items() if isinstance(value, Tensor)}


def compare(arguments: dict[str, Any], **call: Any) -> None:
    """Images within TOLERANCE, and the gradient of a loss over images and alphas by every argument within GRADIENT."""
    wanted, exact = leaves(arguments, torch.float64)
    dense_result = dense.rasterize(**wanted)
    given, float32 = leaves(arguments, torch.float32)
    images, alphas, _ = rasterization(**given, **call)
    steady = dense_result.steady[..., None]
    assert steady.double().mean() > 0.9
    scale = dense_result.images.abs().max().clamp(min=1)
    assert images.shape == dense_result.images.shape
    assert alphas.shape == dense_result.alphas.shape
    assert (((images - dense_result.images) * steady).abs().max() / scale) < TOLERANCE
    assert ((alphas - dense_result.alphas) * steady).abs().max() < TOLERANCE
    weights, of_alpha = drawn(images, 1) * steady, drawn(alphas, 2) * steady
    if "ED" in arguments.get("render_mode", ""):
        # a quotient by 1 - transmittance, which is 1e-7 off: 1e-4 of its derivative where next to nothing is
        weights = weights * dense_result.alphas.detach()
    ((dense_result.images * weights).sum() + (dense_result.alphas * of_alpha).sum()).backward()
    ((images * weights.float()).sum() + (alphas * of_alpha.float()).sum()).backward()
    for name, tensor in exact.items():
        expected, found = tensor.grad, float32[name].grad
        if expected is None or expected.norm() == 0:
            assert found is None or found.norm() == 0, name
            continue
        assert found is not None, name
        if name == "Ks":  # of a matrix whose other numbers are not looked at
            expected, found = expected[..., :2, :], found[..., :2, :]
        assert (found - expected).norm() < GRADIENT * expected.norm(), name


def every(*axes: Sequence[Any], quick: Collection[tuple[Any, ...]]) -> list[Any]:
    """All combinations, of which the quick run has a few."""
    return [pytest.param(*each, marks=() if each in quick else pytest.mark.slow) for each in product(*axes)]


LOW_PASSES = ("classic", "antialiased")


@pytest.mark.parametrize(
    ("degree", "cams", "rasterize_mode"),
    every((0, 1, 2, 3, 4), (1, 3), LOW_PASSES, quick={(0, 1, "classic"), (1, 1, "antialiased"), (3, 3, "classic")}),
)
def test_degrees(degree: int, cams: int, rasterize_mode: str) -> None:
    arguments = clouds.rounded(clouds.cloud(40, degree=degree, cams=cams))
    compare({**arguments, "rasterize_mode": rasterize_mode})


@pytest.mark.parametrize(
    ("width", "cams", "packed"),
    every((1, 3, 4, 32), (1, 3), (False, True), quick={(1, 1, True), (3, 3, False), (4, 1, True)}),
)
def test_channels(width: int, cams: int, packed: bool) -> None:
    arguments = clouds.rounded(clouds.cloud(40, width=width, cams=cams))
    backgrounds = torch.linspace(0, 1, cams * width).reshape(cams, width).double()
    compare({**arguments, "backgrounds": backgrounds.float().double()}, packed=packed)


@pytest.mark.parametrize(
    ("render_mode", "rasterize_mode", "cams", "packed"),
    every(
        MODES, LOW_PASSES, (1, 3), (False, True), quick={("D", "classic", 1, True), ("RGB+ED", "antialiased", 3, False)}
    ),
)
def test_modes(render_mode: str, rasterize_mode: str, cams: int, packed: bool) -> None:
    arguments = clouds.rounded(clouds.cloud(40, degree=1, cams=cams))
    backgrounds = torch.tensor([[0.25, 0.5, 0.75]] * cams).double()
    compare(
        {**arguments, "backgrounds": backgrounds, "render_mode": render_mode, "rasterize_mode": rasterize_mode},
        packed=packed,
    )


def test_packed_gradients_are_those_that_are_not() -> None:
    """To the bit: as they are handed on, changed in place by a hook, in place of others, and with others added."""
    arguments = clouds.rounded(clouds.cloud(40, degree=1, cams=2))
    weights = torch.randn(2, arguments["height"], arguments["width"], 3, generator=torch.Generator().manual_seed(1))

    def doubled(gradient: Tensor) -> Tensor:
        return 2 * gradient

    def in_place(gradient: Tensor) -> None:
        gradient.mul_(2)

    def uncounted(gradient: Tensor) -> None:
        gradient.data.mul_(2)

    def first_of_each(gradient: Tensor) -> Tensor:
        return gradient[..., :1].expand_as(gradient)

    def gradients(packed: bool, hook: Any, depths: bool) -> dict[str, Tensor]:
        given, tensors = leaves(arguments, torch.float32)
        images, _, meta = rasterization(**given, packed=packed)
        if hook is not None:
            meta["means2d"].register_hook(hook)
        loss = (images * weights).sum()
        (loss + meta["depths"].square().sum() if depths else loss).backward()
        return {name: tensor.grad for name, tensor in tensors.items()}

    plain = gradients(packed=True, hook=None, depths=False)
    ways = [(hook, False) for hook in (None, doubled, in_place, uncounted, first_of_each)]
    for hook, depths in (*ways, (None, True)):
        found, wanted = (gradients(packed, hook, depths) for packed in (True, False))
        for name, tensor in found.items():
            assert torch.equal(tensor, wanted[name]), name
        assert torch.equal(found["means"], plain["means"]) == (hook is None and not depths)


@pytest.mark.parametrize("packed", [False, True])
def test_a_call_ends_with_the_last_that_holds_it(packed: bool) -> None:
    """Without the collector, which may come late: a call holds the device's memory."""
    given, _ = leaves(clouds.rounded(clouds.cloud(20)), torch.float32)
    gc.collect()
    gc.disable()
    try:
        images, alphas, meta = rasterization(**given, packed=packed)
        images.sum().backward()
        held = weakref.ref(meta)
        del images, alphas, meta
        assert held() is None
    finally:
        gc.enable()


@pytest.mark.parametrize("packed", [False, True])
def test_a_backward_pass_in_inference_mode(packed: bool) -> None:
    given, tensors = leaves(clouds.rounded(clouds.cloud(20)), torch.float32)
    images, _, _ = rasterization(**given, packed=packed)
    with torch.inference_mode():
        images.backward(torch.ones_like(images))
    assert tensors["means"].grad.norm() > 0


def test_every_driver(device: Device) -> None:
    """The image of each is the oracle's, and so is the gradient."""
    compare(clouds.rounded(clouds.cloud(40, degree=1)), device=device)


@pytest.mark.slow
@pytest.mark.parametrize("camera_model", ["ortho", "fisheye"])
def test_camera_models(camera_model: str) -> None:
    arguments = clouds.rounded(clouds.cloud(40, degree=1, cams=2))
    if camera_model == "ortho":
        arguments["Ks"][:, :2, :2] /= 4
    compare({**arguments, "camera_model": camera_model})


@pytest.mark.parametrize("packed", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_covariances_and_colours_of_each_camera(packed: bool) -> None:
    arguments = clouds.rounded(clouds.cloud(40, cams=3))
    arguments["covars"] = dense.covariances(arguments.pop("quats"), arguments.pop("scales")).float().double()
    arguments["colors"] = torch.stack([arguments["colors"], 1 - arguments["colors"], arguments["colors"] / 2])
    wanted = {**arguments, "quats": None, "scales": None}
    # the upper triangle alone is read, so that the oracle's gradient is of a matrix made from it
    rows, columns = torch.triu_indices(3, 3)
    upper = arguments["covars"][:, rows, columns]
    compare_upper(wanted, upper, packed)


def compare_upper(arguments: dict[str, Any], upper: Tensor, packed: bool) -> None:
    def square(values: Tensor) -> Tensor:
        return values[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)

    results = []
    for kind, function in ((torch.float64, dense.rasterize), (torch.float32, rasterization)):
        given, _ = leaves(arguments, kind)
        free = upper.to(kind, copy=True).requires_grad_()
        given["covars"] = square(free)
        if function is rasterization:
            images, _, _ = rasterization(**given, packed=packed)
        else:
            images = dense.rasterize(**given).images
        (images * drawn(images, 1).to(kind)).sum().backward()
        results.append((images, free.grad, given["means"].grad, given["colors"].grad))
    for expected, found in zip(*results, strict=True):
        assert (found - expected).norm() < GRADIENT * expected.norm()


@pytest.mark.slow  # a cap of alpha has kernels of its own
def test_limits() -> None:
    arguments = clouds.rounded(clouds.cloud(40, degree=0, cams=2))
    compare({**arguments, "near_plane": 3.0, "far_plane": 5.0, "eps2d": 0.1, "radius_clip": 3.0, "alpha_max": 0.7})


@pytest.mark.parametrize("packed", [pytest.param(False, marks=pytest.mark.slow), True])
def test_batches_are_calls(packed: bool) -> None:
    """Two by one batches give what two calls give, bit for bit, gradients too."""
    parts = [clouds.rounded(clouds.cloud(30, degree=1, cams=2, seed=seed)) for seed in (1, 2)]
    tensors = [name for name, value in parts[0].items() if isinstance(value, Tensor)]
    whole = {**parts[0], **{name: torch.stack([part[name] for part in parts])[:, None] for name in tensors}}
    given, free = leaves(whole, torch.float32)
    images, alphas, meta = rasterization(**given, packed=packed)
    assert images.shape == (2, 1, 2, clouds.HEIGHT, clouds.WIDTH, 3)
    assert alphas.shape == (2, 1, 2, clouds.HEIGHT, clouds.WIDTH, 1)
    assert (meta["n_batches"], meta["n_cameras"]) == (2, 2)
    images.square().sum().backward()
    for index, part in enumerate(parts):
        one, free_one = leaves(part, torch.float32)
        image, alpha, about = rasterization(**one, packed=packed)
        image.square().sum().backward()
        assert torch.equal(images[index, 0], image)
        assert torch.equal(alphas[index, 0], alpha)
        for name in tensors:
            assert torch.equal(free[name].grad[index, 0], free_one[name].grad), name
        if packed:
            mine = meta["batch_ids"] == index
            for name in ("camera_ids", "gaussian_ids", "radii", "means2d", "depths", "conics", "opacities"):
                assert torch.equal(meta[name][mine], about[name]), name
        else:
            assert torch.equal(meta["means2d"][index, 0], about["means2d"])


@pytest.mark.parametrize("degree", [None, 1])
def test_no_gaussians(degree: int | None) -> None:
    arguments = clouds.cloud(0, degree=degree)
    given, free = leaves({**arguments, "backgrounds": torch.full((1, 3), 0.5)}, torch.float32)
    images, alphas, meta = rasterization(**given)
    assert torch.equal(images, torch.full_like(images, 0.5))
    assert torch.equal(alphas, torch.zeros_like(alphas))
    assert len(meta["gaussian_ids"]) == 0
    assert len(meta["flatten_ids"]) == 0
    images.sum().backward()
    assert free["means"].grad.shape == (0, 3)


def test_nothing_in_view() -> None:
    given, free = leaves(clouds.cloud(5), torch.float32)
    with torch.no_grad():
        given["means"][:, 2] -= 100
    images, _, meta = rasterization(**given)
    assert images.abs().max() == 0
    assert meta["means2d"].shape == (0, 2)
    images.sum().backward()
    assert free["means"].grad.abs().max() == 0


def test_a_later_call_leaves_earlier_images_as_they_are() -> None:
    first, second = (leaves(clouds.cloud(30, seed=seed), torch.float32)[0] for seed in (1, 2))
    images, alphas, _ = rasterization(**first)
    kept = images.detach().clone(), alphas.detach().clone()
    rasterization(**second)
    assert torch.equal(images, kept[0])
    assert torch.equal(alphas, kept[1])


def test_gradients_of_calls_in_any_order() -> None:
    """Two calls, then their backward passes, first call first: each has its own."""
    arguments = [clouds.cloud(30, seed=seed) for seed in (1, 2)]
    alone = []
    for each in arguments:
        given, free = leaves(each, torch.float32)
        rasterization(**given)[0].square().sum().backward()
        alone.append(free["means"].grad)
    both = [leaves(each, torch.float32) for each in arguments]
    images = [rasterization(**given)[0] for given, _ in both]
    for image in images:
        image.square().sum().backward()
    for (_, free), expected in zip(both, alone, strict=True):
        assert torch.equal(free["means"].grad, expected)


def test_a_graph_that_is_kept_gives_its_gradient_again() -> None:
    given, free = leaves(clouds.cloud(30), torch.float32)
    images, _, _ = rasterization(**given)
    (first,) = torch.autograd.grad(images.square().sum(), free["means"], retain_graph=True)
    (second,) = torch.autograd.grad(images.square().sum(), free["means"])
    assert torch.equal(first, second)
