# SPDX-License-Identifier: Apache-2.0
"""Self-test of the stages that only rendering needs.

The stages are channels other than colour, deep pictures, holdouts, and camera models along rays, such as fisheyes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.random import Generator

from clsplat.camera import CAMERA_MODELS, Camera
from clsplat.cameras.model import CameraModel
from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.images.holdouts import surfaces_of
from clsplat.layouts.columns import DEEP_PICTURES, RAY
from clsplat.reference import channels as reference_channels
from clsplat.reference import deep as reference_deep
from clsplat.reference import deep_merge as reference_deep_merge
from clsplat.reference import every_pixel
from clsplat.reference import holdout as reference_holdout
from clsplat.reference import rays as reference_rays
from clsplat.rendering.rasterizer import ForwardPass, Rasterizer
from clsplat.selftest.case import Arrays, Case, Expected, Inputs, Read
from clsplat.selftest.harness import (
    MIN_DECISION_MARGIN,
    WHITENING_FACTOR,
    Array,
    CaseBench,
    StageOutcome,
    cropped,
    joined,
)
from clsplat.stages.blend import Blended
from clsplat.stages.channels import FEATURE_WIDTHS, Channels, Features, Motion, channels, features
from clsplat.stages.deep import deep
from clsplat.stages.deep_merge import deep_merge
from clsplat.stages.device_camera import pack_camera
from clsplat.stages.holdout import holdout, upload_held

TESTED_FEATURES = Features.of(name for name in FEATURE_WIDTHS if name != "backward")
"""All features except backward motion, which uses the same function as forward motion."""
DIGESTED_FEATURE_PLACES = [
    at + field
    for name, at in TESTED_FEATURES.offsets.items()
    if name in ("depth", "normal", "position", "motion")
    for field in range(FEATURE_WIDTHS[name])
]
"""Columns of the features that the self-test's digests cover. Other features are compared only with the twin."""
MIN_NORMAL_COSINE = 1e-4
"""Least absolute cosine between a normal and the direction to the camera for the normal to be compared. Below it,
rounding may change which side the camera sees."""
MIN_TRANSMITTANCE_MARGIN = 1e-5
"""Nearer than this to a threshold, rounding may change a pixel's result, so the pixel is not compared. In the test of
channels, its transmittance is compared with 0.5, and its largest weight with the second largest. In the test of deep
pictures, its transmittance is compared with the end of a slice."""
MIN_MERGED_MARGIN = 1e-6
"""In the test of merged deep pictures, pixels are not compared if a transmittance is nearer than this to the end of a
slice, where rounding may change the result. The transmittance is a sum of up to 16 products."""
DEEP_CASE_SLICES = 4
"""Number of slices per pixel in the test of deep pictures."""
DEEP_SLICE_PARTS = {"colour": slice(0, 3), "alpha": slice(3, 4), "depth": slice(4, 5)}
"""Columns of a slice, by the names of the quantities that are compared."""

MAX_GAUSSIANS_FOR_REFERENCE = 500
"""Largest number of Gaussians in a scene whose picture along rays is compared. The reference evaluates each Gaussian at
every pixel, which takes a second for this number."""


def _after(camera: Camera) -> Camera:
    """Return the camera at the end of the tested motion: moved in x, y and z, with a larger fx."""
    return replace(camera, translation=camera.translation + np.array([-0.0625, 0.03125, 0.125]), fx=camera.fx + 2.0)


def _features(bench: CaseBench) -> StageOutcome:
    device, camera, visible = bench.device, bench.camera, bench.visible
    motion = Motion(upload(device, pack_camera(_after(camera))))
    view = (bench.model, bench.camera_array, bench.projected, motion)
    bench.features, outcome = bench.twice(
        lambda: features(device, bench.work, TESTED_FEATURES, *view),
        lambda rows: [rows.get()[visible][:, DIGESTED_FEATURE_PLACES]],
    )
    got = bench.features.get()[visible]
    every = reference_channels.features(bench.splats(), bench.frozen.gaussians, camera, _after(camera))
    wanted = {name: values[visible] for name, values in every.items()}
    away = wanted["position"] - camera.position
    clear = np.abs((away * wanted["normal"]).sum(axis=1)) > MIN_NORMAL_COSINE * np.linalg.norm(away, axis=1)
    parts = {
        name: (got[:, at : at + FEATURE_WIDTHS[name]], wanted[name]) for name, at in TESTED_FEATURES.offsets.items()
    }
    parts["normal"] = (parts["normal"][0][clear], wanted["normal"][clear])
    return outcome.compared(parts)


def _channels(bench: CaseBench) -> StageOutcome:
    device, camera = bench.device, bench.camera
    arguments = (bench.features, bench.lists, bench.inputs, bench.blended)
    planes, outcome = bench.twice(
        lambda: channels(device, bench.work, TESTED_FEATURES, *arguments),
        lambda planes: [planes.means.get()[[*DIGESTED_FEATURE_PLACES, -2, -1]], planes.whole.get()],
    )
    splats, (frame, clear) = bench.splats(), bench.blend_reference()
    wanted = reference_channels.channels(splats, bench.frozen.gaussians, camera, _after(camera))
    means, whole = (cropped(array.get(), camera) for array in (planes.means, planes.whole))
    sure = clear & (wanted.doubt > MIN_TRANSMITTANCE_MARGIN)
    # At low alpha, normals may cancel in the sum, so that no digit of the sum is accurate.
    solid = sure & (frame.transmittance < 0.5)
    parts = {
        name: (means[solid, at : at + FEATURE_WIDTHS[name]], wanted.features[name].reshape(*solid.shape, -1)[solid])
        for name, at in TESTED_FEATURES.offsets.items()
    }
    parts["median"] = (means[sure, -2], wanted.median[sure])
    parts["first"] = (means[sure, -1], wanted.first[sure])
    counts = int((whole[sure, 0] != wanted.count[sure]).sum())
    indices = int((whole[sure, 1] != wanted.index[sure]).sum())
    return outcome.compared(parts, counts=counts, indices=indices)


def _deep(bench: CaseBench) -> StageOutcome:
    device, camera = bench.device, bench.camera
    arguments = (bench.lists, bench.inputs, bench.blended)
    bench.slices, outcome = bench.twice(
        lambda: deep(device, bench.work, DEEP_CASE_SLICES, *arguments), lambda slices: [slices.get()]
    )
    (planes,), splats, (_, clear) = outcome.arrays, bench.splats(), bench.blend_reference()
    twin = reference_deep.deep(splats, camera.width, camera.height, DEEP_CASE_SLICES)
    sure = clear & (twin.margin > MIN_TRANSMITTANCE_MARGIN)
    wanted = twin.slices[:, sure]
    got = planes[:, :, : camera.height, : camera.width].transpose(0, 2, 3, 1)[:, sure]
    return outcome.compared({name: (got[..., at], wanted[..., at]) for name, at in DEEP_SLICE_PARTS.items()})


def random_deep_pictures(
    rng: Generator, size: tuple[int, int], count: int | None = None, bins: int | None = None
) -> Inputs:
    """Random deep pictures (P, bins, H, W, 5) with 0 to `bins` slices per pixel, and their weights (P, H, W).

    The weights of each pixel add up to 1. count: number of pictures P. None chooses `count` or `bins` at random.
    """
    count, bins = count or int(rng.choice([1, 2, 3, DEEP_PICTURES])), bins or int(rng.choice([1, 4, 7, 40]))
    shape = (count, bins, size[1], size[0])
    # Alpha is so low that some light passes all slices.
    alpha = (rng.uniform(0.02, 0.95, shape) * min(1, 8 / bins)).astype(np.float32)
    depth = np.cumsum(rng.uniform(0.01, 1, shape), axis=1).astype(np.float32)
    depth[:, :, ::3] = np.round(depth[:, :, ::3]) + np.arange(bins, dtype=np.float32)[:, None, None]  # equal depths
    colours = rng.uniform(-0.2, 1.5, (*shape, 3)).astype(np.float32) * alpha[..., None]
    pictures = np.concatenate([colours, alpha[..., None], depth[..., None]], axis=4)
    slices = rng.integers(0, bins + 1, (count, *shape[2:]))
    pictures[np.arange(bins)[None, :, None, None] >= slices[:, None]] = 0
    weights = rng.uniform(0.1, 1, (count, *shape[2:]))
    return Inputs(pictures=pictures, weights=(weights / weights.sum(axis=0)).astype(np.float32))


def _frozen_deep_pictures(bench: CaseBench) -> list[Inputs]:
    """Four deep pictures: the scene's own, a shifted copy, an upside-down copy, and an unchanged copy.

    Slices of different pictures have equal depths, and all together are more than the merged picture can hold.
    """
    planes = bench.slices.get()
    pictures = np.stack([planes, np.roll(planes, 3, axis=3), planes[:, :, ::-1], planes]).transpose(0, 1, 3, 4, 2)
    return [Inputs(pictures=pictures, weights=np.full((4, *planes.shape[2:]), 0.25, np.float32))]


def launch_deep_merge(device: Device, work: Workspace, given: Inputs) -> Read:
    """Merge the inputs' deep pictures by deep_merge.cl. Returns a function that reads the merged picture."""
    count, bins, height, width, floats = given.pictures.shape
    planes = np.ascontiguousarray(given.pictures.transpose(0, 1, 4, 2, 3)).reshape(count, bins, floats, -1)
    weights = upload(device, np.ascontiguousarray(given.weights.reshape(count, -1)))
    merged = deep_merge(device, work, upload(device, planes), weights)

    def read() -> Arrays:
        planes = merged.get()
        slices = planes.reshape(bins, floats, height, width).transpose(0, 2, 3, 1)
        return {"planes": planes, "slices": slices, **{name: slices[..., at] for name, at in DEEP_SLICE_PARTS.items()}}

    return read


def _twin_of_deep_merge(given: Inputs, _: Arrays) -> dict[str, Expected]:
    pictures, weights = given.wide("pictures", "weights")
    twin = reference_deep_merge.deep_merge(pictures, weights)
    sure = np.broadcast_to(twin.margin > MIN_MERGED_MARGIN, twin.slices.shape[:3])
    # Colours are sums of up to 16 x bins products, times a transmittance of as many factors. Depths are copied.
    bounds = {"colour": 1e-5, "alpha": 1e-5, "depth": 0.0}
    return {name: Expected(twin.slices[..., at], bounds[name], 1.0, sure) for name, at in DEEP_SLICE_PARTS.items()}


DEEP_MERGE_CASE = Case(
    sizes=((1, 1), (13, 5), (16, 4), (65, 1)),
    random=random_deep_pictures,
    launch=launch_deep_merge,
    twin=_twin_of_deep_merge,
    frozen=_frozen_deep_pictures,
    digested=("planes",),
    by_shape=False,
)


def _holdout(bench: CaseBench) -> StageOutcome:
    """Test holdouts with three surfaces, each in some of the pixels: a half-transparent one, an absorbing volume behind
    it, and an opaque wall inside the volume."""
    device, camera = bench.device, bench.camera
    shape = (camera.height, camera.width)
    at = np.arange(camera.height * camera.width).reshape(shape)
    wanted_surfaces = []
    for begin, end, share, every in ((1.5, 1.5, 0.5, 2), (1.75, 3.5, 0.75, 3), (2.75, 2.75, 1.0, 5)):
        there = at % every == 0
        depths = (np.where(there, begin, np.inf), np.where(there, end, np.inf))
        wanted_surfaces.append((*depths, np.full(shape, share)))
    held = upload_held(device, surfaces_of(*(np.stack(parts, axis=2) for parts in zip(*wanted_surfaces, strict=True))))

    def launch() -> Blended:
        blended = bench.blended
        image, left = (upload(device, array.get()) for array in (blended.image, blended.transmittance))
        anew = Blended(image, left, blended.stops, None)
        holdout(device, held, bench.lists, bench.inputs, anew)
        return anew

    _, outcome = bench.twice(launch, lambda anew: [anew.image.get(), anew.transmittance.get()])
    splats, (_, clear) = bench.splats(), bench.blend_reference()
    behind = bench.frozen.background.astype(np.float64)
    image, alpha = reference_holdout.held_out(splats, camera.width, camera.height, wanted_surfaces, behind)
    got, left = (cropped(planes, camera) for planes in outcome.arrays)
    return outcome.compared({"colour": (got[clear], image[clear]), "transmittance": (left[clear], 1 - alpha[clear])})


def _rays(bench: CaseBench) -> StageOutcome:
    """Test each camera model along rays: the projection to tangent planes, and a frame with the depth channel."""
    models = [model for model in CAMERA_MODELS if model.along_rays and model.self_tested]
    return joined([_of_rays(bench, model.projection, _camera_of(bench.camera, model)) for model in models])


def _camera_of(camera: Camera, model: CameraModel) -> Camera:
    """Return a camera of the given model that views a frozen scene. camera: the scene's pinhole camera.

    For the model pinhole, this camera is returned, drawn along rays. A camera of another model is put into the middle
    of the scene, so that Gaussians are all around it, also at a panorama's poles and seam.
    """
    if model.is_pinhole:
        return camera.along_rays(by_rays=True)
    middle = np.array([0.25, -0.125, 4.0])
    rotation = camera.rotation
    translation = -(rotation[:, 0] * middle[0] + rotation[:, 1] * middle[1] + rotation[:, 2] * middle[2])
    focal = model.wide_focal(camera.width)
    centre = (0.5 * camera.width, 0.5 * camera.height)
    amid = Camera(camera.width, camera.height, focal, focal, *centre, rotation, translation)
    return amid.through(model)


def _of_rays(bench: CaseBench, projection: str, camera: Camera) -> StageOutcome:
    # A separate rasterizer with its own workspace, because later stages need the results in the bench's workspace.
    rasterizer, gaussians = Rasterizer(bench.device), bench.frozen.gaussians

    def launch() -> tuple[ForwardPass, Channels]:
        frame = rasterizer.forward(bench.model, camera, bench.background, backward=False)
        return frame, rasterizer.channels(bench.model, frame, Features(), Motion(frame.camera_array))

    def take(results: tuple[ForwardPass, Channels]) -> list[Array]:
        frame, planes = results
        counts = frame.projected.tile_counts.get()
        arrays = (frame.blended.image, frame.blended.transmittance, planes.means, planes.whole)
        return [frame.projected.splats.get()[counts > 0], counts, *(array.get() for array in arrays)]

    _, outcome = bench.twice(launch, take)
    splats, counts, image, left, means, _ = outcome.arrays
    tangents, shown = reference_rays.tangents(gaussians, camera), counts > 0
    parts = _tangent_parts(tangents, shown, splats)
    if bench.model.count <= MAX_GAUSSIANS_FOR_REFERENCE:
        picture = every_pixel.render(gaussians, camera, bench.frozen.background.astype(np.float64))
        # The margin is three times as large as in other stages, because float32 directions are off by 1e-7 at pixels
        # 0.1 radians wide.
        clear = picture.margin > 3 * MIN_DECISION_MARGIN
        solid = clear & (picture.alpha > 0.5)
        parts["image"] = (cropped(image, camera)[clear], picture.image[clear])
        parts["transmittance"] = (cropped(left, camera)[clear], 1 - picture.alpha[clear])
        of_distances = camera.depths_of_distances()
        depth = picture.features["depth"]
        depth = depth if of_distances is None else depth / of_distances
        parts["mean depth"] = (cropped(means, camera)[solid, 0], depth[solid])
    hidden = int((shown & ~tangents.visible).sum())
    return outcome.compared({f"{name}, {projection}": part for name, part in parts.items()}, hidden_Gaussians=hidden)


def _tangent_parts(tangents: reference_rays.Tangents, shown: Any, splats: Array) -> dict[str, tuple[Array, Array]]:
    """Return splat columns of the visible Gaussians, by name: the device's values paired with the reference's.

    tangents: the reference's projection of all n Gaussians. shown: mask (n,) of the visible Gaussians.
    splats: the device's splats of the visible Gaussians.
    """

    def column(*names: str) -> Array:
        return splats[:, [RAY.index(name) for name in names]]

    sxx, sxy, syy = (tangents.covariances[shown][:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    l11 = WHITENING_FACTOR * np.sqrt(syy / (sxx * syy - sxy * sxy))
    u = l11[:, None] * (tangents.right[shown] - (sxy / syy)[:, None] * tangents.down[shown])
    v = (WHITENING_FACTOR / np.sqrt(syy))[:, None] * tangents.down[shown]
    size = np.linalg.norm(u, axis=1, keepdims=True), np.linalg.norm(v, axis=1, keepdims=True)
    return {
        "direction": (column("FX", "FY", "FZ"), tangents.directions[shown]),
        "U": (column("UX", "UY", "UZ") / size[0], u / size[0]),
        "V": (column("VX", "VY", "VZ") / size[1], v / size[1]),
        "distance": (column("DEPTH"), tangents.depths[shown, None]),
        "log2 of opacity": (column("LOG2O"), np.log2(tangents.opacities[shown, None])),
        "colour": (column("RED", "GREEN", "BLUE"), tangents.colors[shown]),
    }


PICTURE_CASES: dict[str, Callable[[CaseBench], StageOutcome]] = {
    "features": _features,
    "channels": _channels,
    "deep": _deep,
    "holdout": _holdout,
    "rays": _rays,
}
