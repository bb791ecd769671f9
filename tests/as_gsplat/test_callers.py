# SPDX-License-Identifier: Apache-2.0
"""What programs that call gsplat do beside its documentation: numbers in other guises, many channels, newer arguments,
names that clsplat does not have."""

from __future__ import annotations

from typing import Any

import pytest
from needs import require

require("torch")

import clouds
import numpy as np
import torch
from clouds import given
from torch import Tensor

import clsplat.torch
from clsplat.errors import InputError
from clsplat.torch import (
    compute_relocation,
    fully_fused_projection,
    isect_offset_encode,
    isect_tiles,
    quat_scale_to_covar_preci,
    rasterization,
    rasterize_to_pixels,
    spherical_harmonics,
)
from clsplat.torch.gsplat.absent_names import CUDA_ONLY_MODULES, CUDA_ONLY_NAMES, PURE_PYTHON_NAMES

pytestmark = pytest.mark.needs("torch")


@pytest.mark.parametrize(
    "changes",
    [
        {"width": torch.tensor(37), "height": torch.tensor(29, dtype=torch.int32)},
        {"width": 37.0, "height": np.float64(29)},
        {"width": torch.tensor(18.5) * 2, "height": torch.tensor([[29]])},
        {"near_plane": torch.tensor(0.01), "far_plane": torch.tensor(10**10), "radius_clip": torch.tensor(0)},
        {"tile_size": torch.tensor(16.0), "channel_chunk": torch.tensor(3), "eps2d": np.float64(0.3)},
        {"tile_size": None, "global_z_order": True, "ut_params": object(), "return_normals": False},
    ],
    ids=["whole tensors", "real numbers", "real tensors", "planes", "tiles", "of gsplat 1.6"],
)
def test_sizes_and_numbers_in_other_guises(changes: dict[str, Any]) -> None:
    images, _, meta = rasterization(**given(**changes))
    expected, _, plain = rasterization(**given())
    assert torch.equal(images, expected)
    assert (meta["width"], meta["height"], meta["tile_size"]) == (plain["width"], plain["height"], 16) == (37, 29, 16)
    assert torch.equal(meta["isect_offsets"], plain["isect_offsets"])


@pytest.mark.parametrize("degree", [torch.tensor(1), 1.0, np.int64(1)], ids=str)
def test_degrees_in_other_guises(degree: Any) -> None:
    made = clouds.rounded(clouds.cloud(8, degree=2))
    tensors = {name: value.float() if isinstance(value, Tensor) else value for name, value in made.items()}
    expected = rasterization(**{**tensors, "sh_degree": 1})[0]
    assert torch.equal(rasterization(**{**tensors, "sh_degree": degree})[0], expected)
    dirs, coeffs = tensors["means"], tensors["colors"]
    assert torch.equal(spherical_harmonics(degree, dirs, coeffs), spherical_harmonics(1, dirs, coeffs))


def test_the_parts_take_numbers_in_other_guises() -> None:
    made = given()
    names = ("means", "quats", "scales", "viewmats", "Ks")
    means, quats, scales, viewmats, Ks = (made[name] for name in names)
    sizes = (torch.tensor(37), 29.0)
    radii, means2d, depths, conics, _ = fully_fused_projection(
        means, None, quats, scales, viewmats, Ks, *sizes, eps2d=torch.tensor(0.3)
    )
    tiles = (torch.tensor(16), 3.0, torch.tensor(2.0))
    _, ids, flat = isect_tiles(means2d, radii, depths, *tiles)
    offsets = isect_offset_encode(ids, torch.tensor(1), *tiles[1:])
    images, _ = rasterize_to_pixels(
        means2d, conics, made["colors"][None], made["opacities"][None], *sizes, 16.0, offsets, flat
    )
    # the tiles of a box, and not those that an ellipse reaches: the same pixels to rounding
    torch.testing.assert_close(images, rasterization(**made)[0], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("channels", "mode"),
    [(768, "RGB+ED"), *(pytest.param(*each, marks=pytest.mark.slow) for each in ((513, "RGB"), (1024, "RGB")))],
)
def test_any_number_of_channels(channels: int, mode: str) -> None:
    """CLIP has 768, DINOv2 1024: what calls with a third of them give, bit for bit, by colours too; by backgrounds to
    the rounding of a sum of a thousand pixels."""
    draw = torch.Generator().manual_seed(channels)
    colors = torch.rand(8, channels, generator=draw)
    backgrounds = torch.rand(1, channels, generator=draw)
    weights = torch.randn(1, 29, 37, channels, generator=draw)

    def drawn(part: slice) -> tuple[Tensor, Tensor, Tensor]:
        leaves = colors[:, part].clone().requires_grad_(), backgrounds[:, part].clone().requires_grad_()
        images = rasterization(**given(colors=leaves[0], backgrounds=leaves[1], render_mode=mode))[0]
        pixels = images[..., : leaves[0].shape[1]]
        by_colors, by_backgrounds = torch.autograd.grad((pixels * weights[..., part]).sum(), leaves)
        return pixels.detach(), by_colors, by_backgrounds

    third = -(-channels // 3)
    parts = [drawn(slice(begin, begin + third)) for begin in range(0, channels, third)]
    pictures, by_colors, by_backgrounds = (torch.cat(pieces, -1) for pieces in zip(*parts, strict=True))
    found = drawn(slice(None))
    assert torch.equal(found[0], pictures)
    assert torch.equal(found[1], by_colors)
    torch.testing.assert_close(found[2], by_backgrounds, rtol=0, atol=1e-4)
    images = rasterization(**given(colors=colors, render_mode=mode))[0]
    assert images.shape == (1, 29, 37, channels + (mode == "RGB+ED"))


@pytest.mark.parametrize("mode", ["RGB", "D", "RGB+ED"])
def test_covariances_with_sparse_gradients(mode: str) -> None:
    """Rows in view alone, of the numbers that a dense gradient has."""
    made = given(40)
    made["means"][:5, 0] += 40  # out of view
    covars, _ = quat_scale_to_covar_preci(made["quats"], made["scales"], compute_preci=False)
    assert covars is not None

    def gradients(sparse: bool) -> tuple[Tensor, Tensor]:
        means, shapes = made["means"].clone().requires_grad_(), covars.clone().requires_grad_()
        changes = {"means": means, "quats": None, "scales": None, "covars": shapes, "render_mode": mode}
        rasterization(**{**made, **changes}, sparse_grad=sparse)[0].square().sum().backward()
        return means.grad, shapes.grad

    for found, dense in zip(gradients(sparse=True), gradients(sparse=False), strict=True):
        assert found.is_sparse
        assert 0 < found._nnz() < 40
        assert torch.equal(found.to_dense(), dense)


@pytest.mark.parametrize("name", ["conics", "opacities"])
def test_tiles_of_an_ellipse_are_refused_by_name(name: str) -> None:
    means2d, radii, depths = torch.zeros(1, 2, 2), torch.ones(1, 2, 2, dtype=torch.int32), torch.ones(1, 2)
    with pytest.raises(InputError, match=f"^{name} is given, expected None"):
        isect_tiles(means2d, radii, depths, 16, 3, 2, **{name: torch.ones(1, 2, 3)})


@pytest.mark.parametrize("mode", ["D", "ED"])
@pytest.mark.parametrize("sh_degree", [None, 3])
def test_depth_alone_needs_no_colours(mode: str, sh_degree: int | None) -> None:
    made = given(render_mode=mode)
    means = made["means"].clone().requires_grad_()
    images = rasterization(**{**made, "means": means, "colors": None, "sh_degree": sh_degree})[0]
    assert torch.equal(images, rasterization(**made)[0])
    images.sum().backward()
    assert means.grad.abs().sum() > 0


def test_the_least_opacity_of_gsplat_1_6() -> None:
    binoms = torch.tensor([[1.0, 0, 0], [1, 1, 0], [1, 2, 1]])
    old, scales, ratios = torch.tensor([0.6, 0.01]), torch.ones(2, 3), torch.tensor([2, 3])
    plain, _ = compute_relocation(old, scales, ratios, binoms)
    least, wide = compute_relocation(old, scales, ratios, binoms, min_opacity=0.005)
    assert plain[1] < 0.005
    assert least.tolist() == pytest.approx([plain[0].item(), 0.005])
    assert torch.isfinite(wide).all()


@pytest.mark.parametrize(
    "transformed",
    [
        lambda seen, means: torch.func.grad(seen)(means),
        lambda seen, means: torch.func.vmap(seen)(means[None]),
        lambda seen, means: torch.func.jvp(seen, (means,), (means,)),
        lambda seen, means: torch.func.jacrev(seen)(means),
    ],
    ids=["grad", "vmap", "jvp", "jacrev"],
)
def test_tensors_of_torch_func_are_refused_by_name(transformed: Any) -> None:
    made = given()

    def seen(means: Tensor) -> Tensor:
        return rasterization(**{**made, "means": means})[0].sum()

    with pytest.raises(
        InputError, match=r"means is a tensor of torch\.func, expected a plain tensor: .*torch\.autograd"
    ):
        transformed(seen, made["means"])


def test_torch_func_may_call_what_is_plain_pytorch() -> None:
    made = given()

    def size(scales: Tensor) -> Tensor:
        covars, _ = quat_scale_to_covar_preci(made["quats"], scales, compute_preci=False)
        return covars.diagonal(dim1=-2, dim2=-1).sum()

    # the trace of R S S^T R^T is the sum of squared scales
    torch.testing.assert_close(torch.func.grad(size)(made["scales"]), 2 * made["scales"])


@pytest.mark.parametrize("name", ["rasterization_2dgs", "proj", "world_to_cam", "rasterize_to_pixels_eval3d"])
def test_names_that_are_absent_are_said(name: str) -> None:
    with pytest.raises(AttributeError, match=f"^{name} is a CUDA function of gsplat that clsplat lacks"):
        getattr(clsplat.torch, name)
    assert not hasattr(clsplat.torch, name)


@pytest.mark.needs("gsplat")
def test_every_name_of_gsplat_is_here_or_absent() -> None:
    """Of gsplat as it is installed: its exports, and what its module of CUDA defines."""
    import inspect
    from importlib import import_module

    gsplat = pytest.importorskip("gsplat")
    exported = {name for name in gsplat.all if not name.startswith("_")}
    wrapper = import_module(CUDA_ONLY_MODULES[0])
    defined = {
        name
        for name, value in inspect.getmembers(wrapper, inspect.isfunction)
        if value.__module__ == wrapper.__name__ and not name.startswith("_")
    }
    ours = {*clsplat.torch.__all__, *CUDA_ONLY_NAMES, *PURE_PYTHON_NAMES}
    assert exported | defined <= ours
