# SPDX-License-Identifier: Apache-2.0
"""The stages of the self-test that only pictures need: channels beside colour, slices by depth, cameras without an
image plane."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from clsplat.camera import PROJECTIONS, Camera, Projection
from clsplat.device.buffers import upload
from clsplat.device.layout import RAY
from clsplat.images.holdouts import surfaces_of
from clsplat.reference import channels as reference_channels
from clsplat.reference import deep as reference_deep
from clsplat.reference import every_pixel
from clsplat.reference import holdout as reference_holdout
from clsplat.reference import rays as reference_rays
from clsplat.rendering.rasterizer import Frame, Rasterizer
from clsplat.selftest.harness import MARGIN, WHITEN, Array, Bench, Outcome, cropped, joined
from clsplat.stages.blend import Blended
from clsplat.stages.channels import WIDTHS, Channels, Features, channels, features
from clsplat.stages.deep import deep
from clsplat.stages.device_camera import pack_camera
from clsplat.stages.holdout import holdout, upload_held

ALL = Features.of(name for name in WIDTHS if name != "backward")
"""Backward motion is motion to another camera, by the same function."""
SIDEWAYS = 1e-4
"""Cosine between a normal and the direction to the camera under which a rounding decides which side is seen."""
DOUBT = 1e-5
"""Margin like `harness.MARGIN`, of the light that is left to one half or to the next slice, and of the two largest
weights."""
BINS = 4
"""Slices of a pixel."""

FEW = 500
"""Gaussians whose picture around the camera the reference makes in a second: it looks at each at every pixel."""


def _after(camera: Camera) -> Camera:
    """The camera that motion goes to: a step aside, up and back, with a longer lens."""
    return replace(camera, translation=camera.translation + np.array([-0.0625, 0.03125, 0.125]), fx=camera.fx + 2.0)


def _features(bench: Bench) -> Outcome:
    device, camera, visible = bench.device, bench.camera, bench.visible
    after = upload(device, pack_camera(_after(camera)))
    bench.features, outcome = bench.twice(
        lambda: features(device, bench.work, ALL, bench.model, bench.camera_array, after, bench.projected),
        lambda rows: [rows.get()[visible]],
    )
    (got,) = outcome.arrays
    every = reference_channels.features(bench.splats(), bench.frozen.gaussians, camera, _after(camera))
    wanted = {name: values[visible] for name, values in every.items()}
    away = wanted["position"] - camera.position
    clear = np.abs((away * wanted["normal"]).sum(axis=1)) > SIDEWAYS * np.linalg.norm(away, axis=1)
    parts = {name: (got[:, at : at + WIDTHS[name]], wanted[name]) for name, at in ALL.offsets.items()}
    parts["normal"] = (parts["normal"][0][clear], wanted["normal"][clear])
    return outcome.compared(parts)


def _channels(bench: Bench) -> Outcome:
    device, camera = bench.device, bench.camera
    arguments = (bench.features, bench.lists, bench.projected, bench.blended, camera.height)
    _, outcome = bench.twice(
        lambda: channels(device, bench.work, ALL, *arguments), lambda planes: [planes.means.get(), planes.whole.get()]
    )
    splats, (frame, clear) = bench.splats(), bench.blend_reference()
    wanted = reference_channels.channels(splats, bench.frozen.gaussians, camera, _after(camera))
    means, whole = (cropped(planes, camera) for planes in outcome.arrays)
    sure = clear & (wanted.doubt > DOUBT)
    # a sum that cancels, as normals may where little is opaque, has no digits of its own
    solid = sure & (frame.transmittance < 0.5)
    parts = {
        name: (means[solid, at : at + WIDTHS[name]], getattr(wanted, name).reshape(*solid.shape, -1)[solid])
        for name, at in ALL.offsets.items()
    }
    parts["median"] = (means[sure, -2], wanted.median[sure])
    parts["first"] = (means[sure, -1], wanted.first[sure])
    counts = int((whole[sure, 0] != wanted.count[sure]).sum())
    indices = int((whole[sure, 1] != wanted.index[sure]).sum())
    return outcome.compared(parts, counts=counts, indices=indices)


def _deep(bench: Bench) -> Outcome:
    device, camera = bench.device, bench.camera
    arguments = (bench.lists, bench.projected.splats, bench.blended, camera.height)
    _, outcome = bench.twice(lambda: deep(device, bench.work, BINS, *arguments), lambda slices: [slices.get()])
    (planes,), splats, (_, clear) = outcome.arrays, bench.splats(), bench.blend_reference()
    twin = reference_deep.deep(splats, camera.width, camera.height, BINS)
    sure = clear & (twin.margin > DOUBT)
    wanted = twin.slices[:, sure]
    got = planes[:, :, : camera.height, : camera.width].transpose(0, 2, 3, 1)[:, sure]
    fields = {"colour": slice(0, 3), "alpha": slice(3, 4), "depth": slice(4, 5)}
    return outcome.compared({name: (got[..., at], wanted[..., at]) for name, at in fields.items()})


def _holdout(bench: Bench) -> Outcome:
    """A surface that is halfway transparent and one that light is lost in, in front of a wall, each in a part of the
    pixels."""
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
        holdout(device, held, bench.lists, bench.projected.splats, bench.background, anew, camera.height)
        return anew

    _, outcome = bench.twice(launch, lambda anew: [anew.image.get(), anew.transmittance.get()])
    splats, (_, clear) = bench.splats(), bench.blend_reference()
    behind = bench.frozen.background.astype(np.float64)
    image, alpha = reference_holdout.held_out(splats, camera.width, camera.height, wanted_surfaces, behind)
    got, left = (cropped(planes, camera) for planes in outcome.arrays)
    return outcome.compared({"colour": (got[clear], image[clear]), "left": (left[clear], 1 - alpha[clear])})


def _rays(bench: Bench) -> Outcome:
    """Projection to tangent planes, and a frame with a channel of it, for each kind of camera."""
    cameras: dict[str, Camera] = {name: _amid(bench.camera, name) for name, kind in PROJECTIONS.items() if kind.rays}
    cameras |= {"perspective": replace(bench.camera, by_rays=True)}
    return joined([_of_rays(bench, name, camera) for name, camera in cameras.items()])


def _amid(camera: Camera, projection: Projection) -> Camera:
    """A camera in the middle of what the frozen scenes show: all around there is something, at the poles and on the
    seam."""
    middle = np.array([0.25, -0.125, 4.0])
    rotation = camera.rotation
    translation = -(rotation[:, 0] * middle[0] + rotation[:, 1] * middle[1] + rotation[:, 2] * middle[2])
    focal = camera.width / (2 * np.pi) if projection == "equirectangular" else 0.25 * camera.width
    centre = (0.5 * camera.width, 0.5 * camera.height)
    return Camera(camera.width, camera.height, focal, focal, *centre, rotation, translation, projection=projection)


def _of_rays(bench: Bench, projection: str, camera: Camera) -> Outcome:
    # with memory of its own: the next stages want what those before have made
    rasterizer, gaussians = Rasterizer(bench.device), bench.frozen.gaussians

    def launch() -> tuple[Frame, Channels]:
        frame = rasterizer.forward(bench.model, camera, bench.background, backward=False)
        return frame, rasterizer.channels(bench.model, frame, Features(), frame.camera_array)

    def take(results: tuple[Frame, Channels]) -> list[Array]:
        frame, planes = results
        counts = frame.projected.tile_counts.get()
        arrays = (frame.blended.image, frame.blended.transmittance, planes.means, planes.whole)
        return [frame.projected.splats.get()[counts > 0], counts, *(array.get() for array in arrays)]

    _, outcome = bench.twice(launch, take)
    splats, counts, image, left, means, _ = outcome.arrays
    tangents, shown = reference_rays.tangents(gaussians, camera), counts > 0
    parts = _tangent_parts(tangents, shown, splats)
    if bench.model.count <= FEW:
        picture = every_pixel.render(gaussians, camera, bench.frozen.background.astype(np.float64))
        clear = picture.margin > 3 * MARGIN  # directions of float32 are good to 1e-7, a pixel is 0.1
        solid = clear & (picture.alpha > 0.5)
        parts["image"] = (cropped(image, camera)[clear], picture.image[clear])
        parts["transmittance"] = (cropped(left, camera)[clear], 1 - picture.alpha[clear])
        of_distances = camera.depths_of_distances()
        depth = picture.depth if of_distances is None else picture.depth / of_distances
        parts["mean depth"] = (cropped(means, camera)[solid, 0], depth[solid])
    hidden = int((shown & ~tangents.visible).sum())
    return outcome.compared({f"{name}, {projection}": part for name, part in parts.items()}, hidden_Gaussians=hidden)


def _tangent_parts(tangents: reference_rays.Tangents, shown: Any, splats: Array) -> dict[str, tuple[Array, Array]]:
    """Columns of the Gaussians that are shown, and their values in float64."""

    def column(*names: str) -> Array:
        return splats[:, [RAY.index(name) for name in names]]

    sxx, sxy, syy = (tangents.covariances[shown][:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    l11 = WHITEN * np.sqrt(syy / (sxx * syy - sxy * sxy))
    u = l11[:, None] * (tangents.right[shown] - (sxy / syy)[:, None] * tangents.down[shown])
    v = (WHITEN / np.sqrt(syy))[:, None] * tangents.down[shown]
    size = np.linalg.norm(u, axis=1, keepdims=True), np.linalg.norm(v, axis=1, keepdims=True)
    return {
        "direction": (column("FX", "FY", "FZ"), tangents.directions[shown]),
        "U": (column("UX", "UY", "UZ") / size[0], u / size[0]),
        "V": (column("VX", "VY", "VZ") / size[1], v / size[1]),
        "distance": (column("DEPTH"), tangents.depths[shown, None]),
        "log2 of opacity": (column("LOG2O"), np.log2(tangents.opacities[shown, None])),
        "colour": (column("RED", "GREEN", "BLUE"), tangents.colors[shown]),
    }


PICTURES: dict[str, Callable[[Bench], Outcome]] = {
    "features": _features,
    "channels": _channels,
    "deep": _deep,
    "holdout": _holdout,
    "rays": _rays,
}
