# SPDX-License-Identifier: Apache-2.0
"""The parts of `clsplat.torch` by themselves, against float64: covariances, relocation, Adam of rows, harmonics,
projection, tiles and pixels."""

from __future__ import annotations

import math
from typing import Any

import pytest
from calls import refuses
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
    fully_fused_projection,
    isect_offset_encode,
    isect_tiles,
    quat_scale_to_covar_preci,
    rasterization,
    rasterize_to_pixels,
    spherical_harmonics,
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
    for name, value in (
        ("scales", torch.ones(2)),
        ("ratios", torch.ones(3)),
        ("ratios", torch.tensor([2.0, math.nan])),
        ("opacities", torch.full((2,), math.nan)),
    ):
        refuses(name, compute_relocation, **{**good, name: value}, binoms=binomials(4))
    refuses("binoms", compute_relocation, **good, binoms=torch.ones(3, 4))


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
    refuses(r"visibility is of shape \(5,\), expected 6 numbers", optimiser.step, torch.ones(5))


def test_adam_of_rows_takes_one_tensor_a_group() -> None:
    tensors = [torch.nn.Parameter(torch.zeros(2)), torch.nn.Parameter(torch.zeros(2))]
    refuses("params is a group of 2 tensors", SelectiveAdam(tensors, eps=1e-8, betas=(0.9, 0.999)).step, torch.ones(2))


@pytest.mark.parametrize("degree", range(5))
def test_harmonics(degree: int) -> None:
    """Values within 1e-6 and gradients within 1e-5 of float64; nothing where the mask is false."""
    directions, coefficients = some(2, 9, 3).float(), some(2, 9, 25, 3, seed=1).float()
    masks = torch.arange(18).reshape(2, 9) % 4 > 0
    weights = some(2, 9, 3, seed=2)
    exact = [each.double().requires_grad_() for each in (directions, coefficients)]
    expected = dense.harmonics(degree, *exact) * masks[..., None]
    (expected * weights).sum().backward()
    given = [each.clone().requires_grad_() for each in (directions, coefficients)]
    found = spherical_harmonics(degree, *given, masks)
    (found * weights.float()).sum().backward()
    assert (found - expected).abs().max() < 1e-6 * max(1, expected.abs().max())
    for one, other in zip(given, exact, strict=True):
        wanted = torch.zeros_like(other) if other.grad is None else other.grad  # degree 0 has no direction
        assert (one.grad - wanted).norm() <= 1e-5 * wanted.norm()
    if degree:
        refuses("coeffs", spherical_harmonics, degree, directions, coefficients[..., :1, :])
    refuses(r"masks is of shape \(9,\)", spherical_harmonics, degree, directions, coefficients, masks[0])


def test_harmonics_name_their_arguments() -> None:
    directions, coefficients = some(5, 3).float(), some(5, 4, 3).float()
    refuses("degrees_to_use is 5", spherical_harmonics, 5, directions, some(5, 36, 3).float())
    refuses(r"dirs is float32 \(5, 2\)", spherical_harmonics, 1, directions[:, :2], coefficients)
    coefficients[2, 1, 0] = math.nan
    refuses(r"^coeffs: \[2, 1, 0\]", spherical_harmonics, 1, directions, coefficients)


@pytest.mark.needs("gsplat")
@pytest.mark.parametrize("degree", range(5))
def test_harmonics_are_gsplats(degree: int) -> None:
    reference = pytest.importorskip("gsplat.cuda._torch_impl")
    directions, coefficients = some(2, 9, 3), some(2, 9, 25, 3, seed=1)
    found = spherical_harmonics(degree, directions.float(), coefficients.float())
    assert (found - reference._spherical_harmonics(degree, directions, coefficients)).abs().max() < 1e-5


MODELS = [("pinhole", True), ("ortho", False), ("ortho", True), ("fisheye", False), ("fisheye", True)]
PROJECTED = ("means2d", "depths", "conics", "compensations")


@pytest.mark.needs("gsplat")
@pytest.mark.parametrize(
    ("camera_model", "from_covariances"),
    [("pinhole", False), *(pytest.param(*each, marks=pytest.mark.slow) for each in MODELS)],
)
def test_projection_is_gsplats(camera_model: Any, from_covariances: bool) -> None:
    """Values within 1e-5, radii but for one in a hundred, which is next to a whole number, gradients within 1e-4."""
    reference = pytest.importorskip("gsplat.cuda._torch_impl")
    made = clouds.rounded(clouds.cloud(60, cams=3))
    inputs = [made[name] for name in ("means", "quats", "scales", "viewmats")]
    exact = [each.clone().requires_grad_() for each in inputs]
    covars = dense.covariances(exact[1], exact[2])
    size = (clouds.WIDTH, clouds.HEIGHT)
    radii, *expected = reference._fully_fused_projection(
        exact[0], covars, exact[3], made["Ks"], *size, calc_compensations=True, camera_model=camera_model
    )
    given = [each.float().requires_grad_() for each in inputs]
    upper = quat_scale_to_covar_preci(given[1], given[2], triu=True)[0] if from_covariances else None
    shape = (upper, None, None) if from_covariances else (None, given[1], given[2])
    found_radii, *found = fully_fused_projection(
        given[0], *shape, given[3], made["Ks"].float(), *size, calc_compensations=True, camera_model=camera_model
    )
    assert (found_radii != radii).float().mean() < 0.01
    seen = ((found_radii > 0) & (radii > 0)).all(-1)
    assert seen.sum() > 30
    # of 1 or more as a share of it: depths and conics are a few, pixels tens
    for name, one, other in zip(PROJECTED, found, expected, strict=True):
        assert ((one - other)[seen].abs() / other[seen].abs().clamp(min=1)).max() < 1e-5, name
    weights = [some(*each.shape, seed=index) for index, each in enumerate(expected)]
    sum((each[seen] * weight[seen]).sum() for each, weight in zip(expected, weights, strict=True)).backward()
    sum((each[seen] * weight[seen].float()).sum() for each, weight in zip(found, weights, strict=True)).backward()
    for name, one, other in zip(("means", "quats", "scales", "viewmats"), given, exact, strict=True):
        assert (one.grad - other.grad).norm() < 1e-4 * other.grad.norm(), name


@pytest.mark.parametrize("sparse_grad", [False, True])
def test_packed_projection(sparse_grad: bool) -> None:
    """Rows of the whole one that are in view, and the same gradients."""
    made = {name: each.float() if isinstance(each, Tensor) else each for name, each in clouds.cloud(60, cams=2).items()}
    made["means"][:9, 0] += 50
    results = []
    for packed in (False, True):
        free = [made[name].clone().requires_grad_() for name in ("means", "quats", "scales")]
        found = fully_fused_projection(
            free[0], None, *free[1:], made["viewmats"], made["Ks"], made["width"], made["height"],
            packed=packed, sparse_grad=sparse_grad and packed, opacities=made["opacities"],
        )  # fmt: skip
        splats = found[-5:]
        assert splats[4] is None
        seen = ... if packed else (splats[0] > 0).all(-1)
        sum(each[seen].square().sum() for each in splats[1:4]).backward()
        results.append((found, splats, free))
    (_, whole, free), (found, packed_splats, free_too) = results
    seen = (whole[0] > 0).all(-1)
    cameras, gaussians = seen.nonzero(as_tuple=True)
    assert [torch.equal(*pair) for pair in zip(found, (0 * cameras, cameras, gaussians), strict=False)] == [True] * 3
    for one, other in zip(whole[:4], packed_splats[:4], strict=True):
        assert torch.equal(one[seen], other)
    for one, other in zip(free, free_too, strict=True):
        assert other.grad.is_sparse == sparse_grad
        assert torch.equal(other.grad.to_dense(), one.grad)


def boxes(images: int, count: int) -> tuple[Tensor, Tensor, Tensor]:
    means2d = some(images, count, 2).float() * 30 + 20
    radii = torch.randint(0, 20, (images, count, 2), generator=torch.Generator().manual_seed(1), dtype=torch.int32)
    return means2d, radii, some(images, count, seed=2).float().abs() + 1


@pytest.mark.needs("gsplat")
def test_tiles_are_gsplats() -> None:
    reference = pytest.importorskip("gsplat.cuda._torch_impl")
    given = (*boxes(3, 25), 16, 4, 3)
    expected, found = reference._isect_tiles(*given), isect_tiles(*given)
    for one, other in zip(found, expected, strict=True):
        assert one.dtype == other.dtype
        assert torch.equal(one, other)
    assert torch.equal(isect_offset_encode(found[1], 3, 4, 3), reference._isect_offset_encode(expected[1], 3, 4, 3))


def test_tiles_of_packed_splats() -> None:
    means2d, radii, depths = boxes(2, 20)
    seen = (radii > 0).all(-1)
    images, gaussians = seen.nonzero(as_tuple=True)
    _, ids, numbers = isect_tiles(means2d, radii, depths, 16, 4, 3)
    per_gauss, packed_ids, packed_numbers = isect_tiles(
        means2d[seen],
        radii[seen],
        depths[seen],
        16,
        4,
        3,
        packed=True,
        n_images=2,
        image_ids=images,
        gaussian_ids=gaussians,
    )
    assert torch.equal(ids, packed_ids)
    assert torch.equal(numbers.long(), (images * 20 + gaussians)[packed_numbers.long()])
    assert per_gauss.shape == images.shape
    refuses("n_images is None", isect_tiles, means2d[seen], radii[seen], depths[seen], 16, 4, 3, packed=True)
    refuses("depths", isect_tiles, means2d, radii, depths[0], 16, 4, 3)


def splats_of(meta: Any, width: int) -> tuple[dict[str, Tensor], Tensor]:
    """Leaves with the splats of a call, and colours for them."""
    free = {name: meta[name].detach().clone().requires_grad_() for name in ("means2d", "conics", "opacities")}
    colors = some(*meta["depths"].shape, width).float().requires_grad_()
    return free, colors


@pytest.mark.parametrize(("width", "packed"), [(3, True), pytest.param(3, False, marks=pytest.mark.slow), (5, False)])
def test_pixels_of_lists_are_those_of_the_whole_call(width: int, packed: bool) -> None:
    """Images within 1e-5 and gradients within 1e-4 of the dense float64 oracle, from the lists that meta has."""
    made = {name: each.float() if isinstance(each, Tensor) else each for name, each in clouds.cloud(40, cams=2).items()}
    size = (clouds.WIDTH, clouds.HEIGHT)
    meta = rasterization(**made, packed=packed)[2]
    free, colors = splats_of(meta, width)
    backgrounds = torch.linspace(0, 1, 2 * width).reshape(2, width).requires_grad_()
    images, alphas = rasterize_to_pixels(
        free["means2d"], free["conics"], colors, free["opacities"], *size, 16, meta["isect_offsets"],
        meta["flatten_ids"], backgrounds, packed=packed, absgrad=True,
    )  # fmt: skip
    rows: Any = (meta["camera_ids"], meta["gaussian_ids"]) if packed else slice(None)

    def whole(values: Tensor) -> Tensor:
        return torch.zeros(2, 40, *values.shape[1:]).double().index_put(rows, values.double()) if packed else values

    exact = {name: each.detach().double().requires_grad_() for name, each in free.items()}
    exact_colors, exact_behind = (
        colors.detach().double().requires_grad_(),
        backgrounds.detach().double().requires_grad_(),
    )
    projected = dense.Projected(
        whole(exact["means2d"]), whole(exact["conics"]), whole(meta["depths"].detach()),
        torch.ones(2, 40).double(), whole(meta["radii"]),
    )  # fmt: skip
    picture, left, steady = dense.composite(projected, whole(exact_colors), whole(exact["opacities"]), *size, 0.999)
    picture = picture + left * exact_behind[:, None, None]
    steady = steady[..., None]
    assert ((images - picture) * steady).abs().max() < 1e-5
    assert ((alphas - (1 - left)) * steady).abs().max() < 1e-5
    weights = some(*images.shape) * steady
    (picture * weights).sum().backward()
    (images * weights.float()).sum().backward()
    pairs = [*((free[name], exact[name]) for name in free), (colors, exact_colors), (backgrounds, exact_behind)]
    for one, other in pairs:
        assert (one.grad - other.grad).norm() < 1e-4 * other.grad.norm()
    absolute = free["means2d"].absgrad
    assert (absolute >= free["means2d"].grad.abs() * (1 - 1e-4) - 1e-6).all()


def test_tiles_that_are_masked_have_the_background_alone() -> None:
    made = {name: each.float() if isinstance(each, Tensor) else each for name, each in clouds.cloud(40).items()}
    meta = rasterization(**made, packed=False)[2]
    splats = (meta["means2d"], meta["conics"], made["colors"][None], meta["opacities"])
    lists = (clouds.WIDTH, clouds.HEIGHT, 16, meta["isect_offsets"], meta["flatten_ids"], torch.full((1, 3), 0.5))
    masks = torch.ones(1, 2, 3, dtype=torch.bool)
    masks[0, 0, 1] = False
    images, alphas = rasterize_to_pixels(*splats, *lists, masks)
    plain, _ = rasterize_to_pixels(*splats, *lists)
    assert torch.equal(images[0, :16, 16:32], torch.full((16, 16, 3), 0.5))
    assert alphas[0, :16, 16:32].abs().max() == 0
    assert torch.equal(images[0, 16:], plain[0, 16:])
    refuses("tile_size", rasterize_to_pixels, *splats, lists[0], lists[1], 8, *lists[3:])
    with pytest.raises(InputError, match=r"opacities is float32 \(40,\), expected a tensor \(1, 40\)"):
        rasterize_to_pixels(*splats[:3], meta["opacities"][0], *lists)
