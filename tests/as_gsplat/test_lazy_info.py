# SPDX-License-Identifier: Apache-2.0
"""`meta` of `clsplat.torch.rasterization`: layouts, what is made late, gradients of splats, sparse gradients."""

from __future__ import annotations

import pickle
from typing import Any

import pytest
from calls import refuses
from needs import require

require("torch")

import clouds
import torch

from clsplat.torch import rasterization
from clsplat.torch.lazy_info import Meta

pytestmark = pytest.mark.needs("torch")

NAMES = [
    "batch_ids", "camera_ids", "gaussian_ids", "radii", "means2d", "depths", "conics", "opacities", "tile_width",
    "tile_height", "tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets", "width", "height", "tile_size",
    "n_batches", "n_cameras",
]  # fmt: skip
"""gsplat 1.5.3's, in its order."""
GRADIENTS = ("means", "quats", "scales", "opacities", "colors", "viewmats")


def given(cams: int = 2, **changes: Any) -> dict[str, Any]:
    made = clouds.cloud(40, degree=1, cams=cams)
    made["means"][:5, 0] += 40  # out of view
    tensors = {name: value.float() for name, value in made.items() if isinstance(value, torch.Tensor)}
    for name in GRADIENTS:
        tensors[name].requires_grad_()
    return {**made, **tensors, **changes}


def test_names() -> None:
    assert list(rasterization(**given())[2]) == NAMES


def test_layouts() -> None:
    _, _, whole = rasterization(**given(), packed=False)
    _, _, packed = rasterization(**given())
    assert whole["radii"].dtype == torch.int32
    assert (whole["batch_ids"], whole["camera_ids"], whole["gaussian_ids"]) == (None, None, None)
    seen = (whole["radii"] > 0).all(-1)
    assert 0 < seen.sum() < seen.numel()
    for name, width in (("radii", (2,)), ("means2d", (2,)), ("depths", ()), ("conics", (3,)), ("opacities", ())):
        assert whole[name].shape == (2, 40, *width)
        assert torch.equal(whole[name][seen], packed[name]), name
    cameras, gaussians = seen.nonzero(as_tuple=True)
    assert torch.equal(packed["camera_ids"], cameras)
    assert torch.equal(packed["gaussian_ids"], gaussians)
    assert torch.equal(packed["batch_ids"], torch.zeros_like(cameras))
    assert (whole["tile_width"], whole["tile_height"], whole["isect_offsets"].shape) == (3, 2, (2, 2, 3))
    assert torch.equal(whole["tiles_per_gauss"][seen], packed["tiles_per_gauss"])
    assert torch.equal(whole["isect_ids"], packed["isect_ids"])
    assert torch.equal(whole["isect_offsets"], packed["isect_offsets"])
    numbers = seen.flatten().nonzero()[:, 0]
    assert torch.equal(whole["flatten_ids"].long(), numbers[packed["flatten_ids"].long()])


@pytest.mark.parametrize("packed", [False, True])
def test_the_gradient_of_means2d_is_there_to_retain(packed: bool) -> None:
    """Its share of the gradient of means, by the chain rule through the pinhole, is that of a loss over means2d."""
    images, _, meta = rasterization(**given(), packed=packed, absgrad=True)
    meta["means2d"].retain_grad()
    images.square().sum().backward()
    found, absolute = meta["means2d"].grad, meta["means2d"].absgrad
    assert found.shape == absolute.shape == meta["means2d"].shape
    assert found.abs().max() > 0
    assert (absolute >= found.abs() * (1 - 1e-4) - 1e-7).all()


@pytest.mark.parametrize("packed", [False, True])
def test_splats_take_losses(packed: bool) -> None:
    """Gradients of losses over entries of meta, and over images and entries together."""
    one = given()
    images, _, meta = rasterization(**one, packed=packed)
    splats = (
        meta["means2d"][..., 0].sum() + meta["depths"].square().sum() + meta["opacities"].sum() + meta["conics"].sum()
    )
    shown = meta["radii"].prod(-1) > 0
    splats = sum(
        (meta[name][shown] * factor).sum()
        for name, factor in (("means2d", 0.1), ("depths", 0.2), ("conics", 0.3), ("opacities", 0.4))
    )
    (alone,) = torch.autograd.grad(splats, one["means"], retain_graph=True)
    (of_images,) = torch.autograd.grad(images.sum(), one["means"], retain_graph=True)
    (both,) = torch.autograd.grad(splats + images.sum(), one["means"])
    assert alone.abs().max() > 0
    assert (both - alone - of_images).norm() < 1e-5 * both.norm()


@pytest.mark.parametrize("cams", [1, 2])
def test_sparse_gradients(cams: int) -> None:
    dense, sparse = given(cams), given(cams)
    rasterization(**dense)[0].square().sum().backward()
    images, _, meta = rasterization(**sparse, sparse_grad=True)
    images.square().sum().backward()
    for name in ("means", "quats", "scales"):
        found = sparse[name].grad
        assert found.is_sparse
        assert torch.equal(found.coalesce().indices()[0], meta["gaussian_ids"].unique())
        assert torch.equal(found.to_dense(), dense[name].grad), name
    assert torch.equal(sparse["colors"].grad, dense["colors"].grad)
    torch.optim.SparseAdam([sparse["means"]]).step()


def test_parameters_that_are_changed_before_the_gradient_are_an_error() -> None:
    made = given()
    images, _, _ = rasterization(**made)
    with torch.no_grad():
        made["means"].add_(1)
    refuses("modified by an inplace operation", images.sum().backward, error=RuntimeError)


def test_results_that_are_changed_in_place() -> None:
    """An error where the gradient reads them; the image of colours alone may be."""
    images, alphas, _ = rasterization(**given())
    images.mul_(2)
    images.sum().backward()
    images, alphas, _ = rasterization(**given())
    alphas.mul_(2)
    refuses("modified by an inplace operation", images.sum().backward, error=RuntimeError)
    images, _, _ = rasterization(**given(), render_mode="ED")
    images.mul_(2)
    refuses("modified by an inplace operation", images.sum().backward, error=RuntimeError)


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("cams", [1, 2])
def test_without_gradients(cams: int, packed: bool, mode: str) -> None:
    """Entries that `meta` makes later are of the arguments as they were at the call."""
    made = given(cams)
    wanted = rasterization(**made, packed=packed, rasterize_mode=mode)[2]
    expected = {name: wanted[name].clone() if torch.is_tensor(wanted[name]) else wanted[name] for name in wanted}
    with torch.no_grad():
        images, alphas, meta = rasterization(**made, packed=packed, rasterize_mode=mode)
        for value in made.values():
            if torch.is_tensor(value):
                value.mul_(0.5)
    assert not (images.requires_grad or alphas.requires_grad or meta["means2d"].requires_grad)
    assert list(meta) == list(wanted)
    for name, value in expected.items():
        assert torch.equal(meta[name], value) if torch.is_tensor(value) else meta[name] == value, name


@pytest.mark.parametrize("packed", [False, True])
def test_opacities_are_the_calls_own(packed: bool) -> None:
    """With one camera the library has no others than the caller's."""
    made = given(cams=1)
    meta = rasterization(**made, packed=packed)[2]
    before = meta["opacities"].detach().clone()
    with torch.no_grad():
        made["opacities"].mul_(0.5)
    assert torch.equal(meta["opacities"], before)


def test_radii_that_are_changed_in_place_leave_the_tiles() -> None:
    wanted = rasterization(**given())[2]["flatten_ids"]
    meta = rasterization(**given())[2]
    meta["radii"].mul_(3)
    assert torch.equal(meta["flatten_ids"], wanted)


class Counted:
    calls = 0

    def make(self) -> dict[str, int]:
        self.calls += 1
        return {"late": 2, "later": 3}


def late() -> tuple[Meta, Counted]:
    counted, meta = Counted(), Meta({"first": 1})
    meta.later(("late", "later"), counted.make)
    return meta, counted


def test_what_is_made_late_is_made_once() -> None:
    meta, counted = late()
    assert list(meta) == ["first", "late", "later"]
    assert "late" in meta
    assert meta["first"] == meta.get("first") == 1
    assert counted.calls == 0
    assert (meta["late"], meta["later"], meta.get("late"), meta.get("none", 5)) == (2, 3, 2, 5)
    assert counted.calls == 1


@pytest.mark.parametrize(
    "as_plain",
    [
        dict,
        lambda meta: {**meta},
        lambda meta: meta.copy(),
        lambda meta: {} | meta,
        lambda meta: meta | {},
        lambda meta: dict(meta.items()),
        lambda meta: dict(zip(meta, meta.values(), strict=True)),
        lambda meta: pickle.loads(pickle.dumps(meta)),
        lambda meta: {name: meta.pop(name) for name in list(meta)},
        lambda meta: {name: meta.setdefault(name, 9) for name in meta},
    ],
)
def test_a_plain_dictionary_of_it_has_everything(as_plain: Any) -> None:
    meta, _ = late()
    assert as_plain(meta) == {"first": 1, "late": 2, "later": 3}
    assert late()[0] == {"first": 1, "late": 2, "later": 3}
    assert "2" in repr(late()[0])


def test_an_entry_that_is_set_is_not_made() -> None:
    meta, counted = late()
    meta["late"] = 7
    assert (meta["late"], counted.calls, meta["later"], meta["late"]) == (7, 0, 3, 7)
    del meta["later"]
    assert "later" not in meta


@pytest.mark.parametrize("packed", [False, True])
def test_tiles_are_the_calls_whatever_becomes_of_other_entries(packed: bool) -> None:
    _, _, wanted = rasterization(**given(), packed=packed)
    _, _, meta = rasterization(**given(), packed=packed)
    meta["radii"] = meta["radii"].amax(-1)
    for name in ("batch_ids", "camera_ids", "gaussian_ids"):
        del meta[name]
    assert torch.equal(meta["tiles_per_gauss"], wanted["tiles_per_gauss"])
    assert torch.equal(meta["flatten_ids"], wanted["flatten_ids"])


def test_entries_that_are_set_are_not_made_over() -> None:
    meta = Meta({"first": 1})
    meta.later(("late", "later"), lambda: {"late": 2, "later": 3})
    meta.update({"late": "mine"}, first=4)
    assert (meta["late"], meta["first"], meta["later"]) == ("mine", 4, 3)
    meta.later(("late",), lambda: {"late": 2})
    meta |= {"late": "again"}
    assert type(meta) is Meta
    assert meta["late"] == "again"
    meta.later(("late",), lambda: {"late": 2})
    assert meta.popitem() == ("later", 3)
    assert meta.popitem() == ("late", 2)
    meta.later(("late",), lambda: {"late": 2})
    meta.clear()
    assert "late" not in meta
    assert meta.get("late") is None
    with pytest.raises(KeyError):
        meta.popitem()
