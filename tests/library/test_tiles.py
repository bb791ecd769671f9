# SPDX-License-Identifier: Apache-2.0
"""Lists of tiles against a loop over them and against gsplat's own, and the pixels of lists that are given."""

from __future__ import annotations

import numpy as np
import pytest
from calls import refuses
from compare import assert_close, assert_close_gradient, assert_same_bits
from flat import Flat, cloud
from numpy.typing import NDArray

from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.library.tile_list_pixels import RasterizedPixels, rasterize_to_pixels
from clsplat.library.tiles import isect_offset_encode, isect_tiles
from clsplat.reference import values as twin

WIDTH, HEIGHT, TILES = 45, 35, (3, 3)


def flats(count: int, images: int, depth: int = 3) -> list[Flat]:
    return [cloud(count, WIDTH, HEIGHT, depth, seed=seed) for seed in range(images)]


def stacked(of: list[Flat], name: str) -> NDArray[np.float32]:
    return np.stack([getattr(flat, name) for flat in of])


def lists(of: list[Flat]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Offsets and Gaussians, of radii that are large enough."""
    radii = np.where(stacked(of, "radii") > 0, 40, 0)
    _, ids, listed = isect_tiles(stacked(of, "means2d"), radii, stacked(of, "depths"), 16, *TILES)
    return isect_offset_encode(ids, len(of), *TILES), listed


def drawn(of: list[Flat], device: Device, **how: object) -> RasterizedPixels:
    names = ("means2d", "conics", "colours", "opacities")
    return rasterize_to_pixels(
        *(stacked(of, name) for name in names), WIDTH, HEIGHT, 16, *lists(of), device=device, **how
    )


def test_pairs_against_a_loop() -> None:
    of = flats(30, 2)
    means, radii, depths = stacked(of, "means2d"), stacked(of, "radii"), stacked(of, "depths")
    counts, ids, listed = isect_tiles(means, radii, depths, 16, *TILES)
    rows = []
    for image in range(2):
        for i in range(30):
            if (radii[image, i] <= 0).any():
                continue
            low = np.clip(np.floor((means[image, i] - radii[image, i]) / 16), 0, TILES).astype(int)
            high = np.clip(np.ceil((means[image, i] + radii[image, i]) / 16), 0, TILES).astype(int)
            bits = int(depths[image, i].view(np.int32))
            found = [
                (image, y * 3 + x, bits, 30 * image + i) for y in range(low[1], high[1]) for x in range(low[0], high[0])
            ]
            assert len(found) == counts[image, i]
            rows += found
    rows.sort()
    assert ids.dtype == np.int64 and listed.dtype == np.int32
    assert ids.tolist() == [(image << 36) | (tile << 32) | bits for image, tile, bits, _ in rows]
    assert listed.tolist() == [gaussian for *_, gaussian in rows]
    offsets = isect_offset_encode(ids, 2, *TILES)
    first = [sum(row[:2] < (image, tile) for row in rows) for image in range(2) for tile in range(9)]
    assert offsets.reshape(-1).tolist() == first
    unsorted = isect_tiles(means, radii, depths, 16, *TILES, sort=False)
    assert (np.diff(unsorted[2]) >= 0).all()
    packed = isect_tiles(
        *(array.reshape(60, -1).squeeze() for array in (means, radii, depths)),
        16,
        *TILES,
        image_ids=np.repeat([0, 1], 30),
        n_images=2,
    )
    assert_same_bits(packed[1], ids)
    assert_same_bits(packed[2], listed)


@pytest.mark.needs("torch")
@pytest.mark.needs("gsplat")
def test_pairs_are_those_of_gsplat() -> None:
    import torch
    from gsplat.cuda import _torch_impl as impl

    of = flats(6, 2)  # it is a loop over tensors
    arrays = (stacked(of, "means2d"), stacked(of, "radii"), stacked(of, "depths"))
    counts, ids, _ = isect_tiles(*arrays, 16, *TILES)
    wanted = impl._isect_tiles(*(torch.from_numpy(array) for array in arrays), 16, *TILES)  # its reference
    assert_same_bits(counts, wanted[0].numpy())
    assert_same_bits(ids, wanted[1].numpy())
    offsets = impl._isect_offset_encode(wanted[1], 2, *TILES)  # as above
    assert_same_bits(isect_offset_encode(ids, 2, *TILES), offsets.numpy())


@pytest.mark.parametrize("depth", [3, 5])
def test_pixels_of_lists_against_dense_compositing(device: Device, depth: int) -> None:
    of, rng = flats(60, 2, depth), np.random.default_rng(5)
    backgrounds = rng.uniform(0, 1, (2, depth)).astype(np.float32)
    got = drawn(of, device, backgrounds=backgrounds)
    assert got.colors.shape == (2, HEIGHT, WIDTH, depth) and got.alphas.shape == (2, HEIGHT, WIDTH, 1)
    d_colors = rng.normal(size=got.colors.shape).astype(np.float32)
    d_alphas = rng.normal(size=got.alphas.shape).astype(np.float32)
    blended = [
        twin.blend_values(flat.twin, WIDTH, HEIGHT, behind) for flat, behind in zip(of, backgrounds, strict=True)
    ]
    sure = np.stack([each.margin > 1e-4 for each in blended])
    # alpha is good to 2e-7 of itself in each of a few layers
    assert_close(got.colors[sure], np.stack([each.image for each in blended])[sure], absolute=1e-6)
    d_colors[~sure], d_alphas[~sure] = 0, 0
    found = got.vjp(d_colors, d_alphas, absolute=True)
    assert {name: array.shape for name, array in found.items()} == {
        "means2d": (2, 60, 2),
        "conics": (2, 60, 3),
        "colors": (2, 60, depth),
        "opacities": (2, 60),
        "absolute": (2, 60, 2),
        "backgrounds": (2, depth),
    }
    names = {"colors": "values", "backgrounds": "background"}
    for image, flat in enumerate(of):
        given = (backgrounds[image], d_colors[image], d_alphas[image, :, :, 0])
        wanted = twin.blend_values_grad(flat.twin, WIDTH, HEIGHT, *given)
        for name, array in found.items():
            # sums of up to some hundred pixels, of transmittances that are recovered by division
            assert_close_gradient(array[image], getattr(wanted, names.get(name, name)), 5e-6, name=name)


def test_packed_arrays_and_masks(default_device: Device) -> None:
    of = flats(40, 2)
    whole = drawn(of, default_device)
    names = ("means2d", "conics", "colours", "opacities")
    packed = [stacked(of, name).reshape(80, -1) for name in names[:3]] + [stacked(of, "opacities").reshape(80)]
    got = rasterize_to_pixels(*packed, WIDTH, HEIGHT, 16, *lists(of), device=default_device)
    assert_same_bits(got.colors, whole.colors)
    d_colors = np.random.default_rng(0).normal(size=got.colors.shape)
    flat, shaped = got.vjp(d_colors), whole.vjp(d_colors)
    for name, array in flat.items():
        assert_same_bits(array, shaped[name].reshape(array.shape), name)
    masks = np.ones((2, 3, 3), np.bool_)
    masks[1, 0, 1] = False
    backgrounds = np.full((2, 3), 0.25, np.float32)
    plain, masked = (
        drawn(of, default_device, backgrounds=backgrounds),
        drawn(of, default_device, backgrounds=backgrounds, masks=masks),
    )
    assert_same_bits(masked.colors[0], plain.colors[0])
    assert (masked.colors[1, :16, 16:32] == 0.25).all() and not masked.alphas[1, :16, 16:32].any()
    assert_same_bits(masked.colors[1, 16:], plain.colors[1, 16:])
    hidden = np.zeros_like(d_colors)
    hidden[1, :16, 16:32] = 1
    assert not masked.vjp(hidden)["means2d"].any()
    assert plain.vjp(hidden)["means2d"].any()


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"tile_size": 8}, "tile_size: got 8, expected 16"),
        ({"conics": np.zeros((2, 9, 2))}, "conics: got shape"),
        ({"colors": np.zeros((2, 9, 0))}, "colors has 0 channels, expected 1 or more"),
        ({"opacities": np.full((2, 9), np.nan)}, "opacities"),
        ({"isect_offsets": np.zeros((2, 3, 4), np.int32)}, "isect_offsets: got int32 of shape"),
        ({"isect_offsets": np.full((2, 3, 3), 7, np.int32)}, "isect_offsets: got decreasing numbers"),
        ({"flatten_ids": np.array([18])}, "flatten_ids: got 18 to 18, expected 0 to 17"),
        ({"flatten_ids": np.array([0.5])}, "flatten_ids: got float64"),
        ({"masks": np.ones((2, 3, 3))}, "masks: got float64"),
        ({"backgrounds": np.zeros(3)}, "backgrounds: got shape"),
        ({"alpha_max": 1.0}, "alpha_max: got 1.0"),
        ({"image_width": 0}, "image_width, image_height: got 0 x 35"),
    ],
)
def test_what_makes_no_sense_is_named(default_device: Device, changed: dict[str, object], told: str) -> None:
    of = flats(9, 2)
    names = {"means2d": "means2d", "conics": "conics", "colors": "colours", "opacities": "opacities"}
    given: dict[str, object] = {name: stacked(of, attribute) for name, attribute in names.items()}
    given |= {"image_width": WIDTH, "image_height": HEIGHT, "tile_size": 16}
    given |= {"isect_offsets": np.zeros((2, 3, 3), np.int32), "flatten_ids": np.zeros(0, np.int32)}
    refuses(told, rasterize_to_pixels, **{**given, **changed}, device=default_device)  # type: ignore[arg-type]  # wrong on purpose


def test_ids_that_make_no_sense() -> None:
    refuses("beyond the 1 images of 3 x 3", isect_offset_encode, np.array([1 << 36]), 1, 3, 3)
    with pytest.raises(InputError, match="image_ids"):
        isect_tiles(
            np.zeros((4, 2)), np.zeros((4, 2)), np.zeros(4), 16, 3, 3, image_ids=np.zeros(3, np.int32), n_images=1
        )
    with pytest.raises(InputError, match="n_images"):
        isect_tiles(np.zeros((4, 2)), np.zeros((4, 2)), np.zeros(4), 16, 3, 3, image_ids=np.arange(4), n_images=2)
