# SPDX-License-Identifier: Apache-2.0
"""Self-test of the stages that only the functions of `clsplat.library` launch, and of their gradients.

The stages are EWA projection with any view matrix, SH colours, splats from arrays, and blending of any number of values
per Gaussian.
"""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
from numpy.random import Generator

from clsplat.arrays import Float32, Float64
from clsplat.device.buffers import DeviceArray, Workspace, allocate, from_host, upload
from clsplat.device.context import Device
from clsplat.layouts.columns import SPLAT
from clsplat.reference import ewa as reference_ewa
from clsplat.reference import splats as reference_splats
from clsplat.reference import values as reference_values
from clsplat.reference.sh import sh_basis_grad
from clsplat.selftest.case import Arrays, Case, Expected, Inputs, Read, exactly
from clsplat.selftest.harness import WHITENING_FACTOR, Array, CaseBench, StageOutcome
from clsplat.selftest.scenes import evenly
from clsplat.spherical_harmonics import sh_basis
from clsplat.stages.ewa import (
    Ewa,
    EwaCamera,
    EwaGradients,
    EwaImageGradients,
    EwaInputs,
    PlacedEwaCamera,
    camera_gradients,
    ewa,
    ewa_grad,
)
from clsplat.stages.harmonics import (
    MAX_SH_BASIS_DEGREE,
    Harmonics,
    HarmonicsGradients,
    centre_array,
    harmonics,
    harmonics_grad,
)
from clsplat.stages.splats import ScreenGaussians, ScreenGradients, splats
from clsplat.stages.values import ValuePass, values, values_grad

VALUES_PER_GAUSSIAN = 5
"""Number of values per Gaussian in the test: more than the three that blend.cl can blend."""
WRITTEN_SPLAT_COLUMNS = {name: k for k, name in enumerate(SPLAT) if name != "UNUSED"}


def of_ewa(bench: CaseBench) -> StageOutcome:
    """Test EWA projection and its gradient, with compensations and a view matrix that is not a rotation."""
    device, camera, model = bench.device, bench.camera, bench.frozen.gaussians
    n = len(model.means)
    pose, lens = np.eye(4), np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    pose[:3, :3], pose[:3, 3] = camera.rotation + 0.03125 * np.eye(3), camera.translation
    scales = (evenly(61, (n, 3), 0.0625, 0.25)).astype(np.float32)
    opacities = evenly(62, (n,), 0.0625, 1.0).astype(np.float32)
    seen_by = EwaCamera(pose, lens, camera.width, camera.height, near=0.25)
    given = {"means": model.means, "quaternions": model.quaternions, "scales": scales, "opacities": opacities}
    means, quaternions, placed_scales, covers = (upload(device, array) for array in given.values())
    inputs = EwaInputs(means, quaternions, placed_scales, opacities=covers)
    shapes = {"means2d": (n, 2), "depths": (n,), "conics": (n, 3), "compensations": (n,)}
    by = {
        name: evenly(63 + index, shape, -1.0, 1.0).astype(np.float32)
        for index, (name, shape) in enumerate(shapes.items())
    }

    def launch() -> tuple[Ewa, EwaGradients, DeviceArray]:
        work = bench.work
        arrays = [work.array(f"ewa_{name}", shape) for name, shape in shapes.items()]
        projected = Ewa(work.array("ewa_radii", (n, 2), np.int32), *arrays)
        widths = {"means": 3, "quaternions": 4, "scales": 3}
        into = EwaGradients(*(work.array(f"by_{name}", (n, width)) for name, width in widths.items()))
        placed = PlacedEwaCamera.on(device, seen_by)
        ewa(device, inputs, placed, projected)
        on_image = EwaImageGradients(*(upload(device, array) for array in by.values()))
        sums = ewa_grad(device, work, inputs, placed, projected, on_image, into, by_camera=True)
        assert sums is not None
        return projected, into, sums

    def take(results: tuple[Ewa, EwaGradients, DeviceArray]) -> list[Array]:
        projected, into, sums = results
        on_image = [getattr(projected, name).get() for name in ("radii", *shapes)]
        return [*on_image, *(array.get() for array in into.arrays), sums.get()]

    _, outcome = bench.twice(launch, take)
    names = ("radii", *shapes, "means", "quaternions", "scales", "camera")
    got = dict(zip(names, outcome.arrays, strict=True))
    exact = {name: array.astype(np.float64) for name, array in given.items()}
    view = reference_ewa.EwaViewTwin(pose, lens, camera.width, camera.height, near=0.25)
    covariances = reference_ewa.covariances_of(exact["quaternions"], exact["scales"])
    alone = reference_ewa.project(exact["means"], covariances, view)
    wanted = reference_ewa.project(exact["means"], covariances, view, exact["opacities"] * alone.compensations)
    off = np.abs(got["radii"] - wanted.radii)
    both = wanted.visible & (got["radii"][:, 0] > 0)
    wrong = int((off[both] > 1).sum()) + max(int((off > 0).sum()) - 2, 0)  # up to two radii may be rounded differently
    wanted = replace(wanted, radii=got["radii"])
    back = reference_ewa.project_grad(
        exact["means"], covariances, view, wanted, {name: array.astype(np.float64) for name, array in by.items()}
    )
    by_shape = reference_ewa.covariances_grad(exact["quaternions"], exact["scales"], back["covariances"])
    by_pose, by_lens = camera_gradients(got["camera"])
    parts = {name: (got[name][both], getattr(wanted, name)[both]) for name in shapes}
    parts |= {"by means": (got["means"], back["means"]), "by quaternions": (got["quaternions"], by_shape[0])}
    parts |= {"by scales": (got["scales"], by_shape[1]), "by view": (by_pose, back["viewmat"])}
    return outcome.compared({**parts, "by lens": (by_lens, back["intrinsics"])}, radii=wrong)


def conics_of(sides: Float64, angles: Float64) -> Float32:
    """Conics (n, 3) of ellipses. sides: standard deviations (n, 2) along the axes, in pixels; angles: rotations (n,) in
    radians."""
    axes = np.stack([np.cos(angles), -np.sin(angles), np.sin(angles), np.cos(angles)], axis=1).reshape(-1, 2, 2)
    inverse = (axes / sides[:, None, :] ** 2) @ axes.transpose(0, 2, 1)
    return np.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], axis=1).astype(np.float32)


def random_splats(
    rng: Generator, count: int, *, width: int = 70, height: int = 50, depth: int = 3, opaque: float = 0.1
) -> Inputs:
    """Random projected Gaussians of a few pixels, spread over an image and slightly past its edges. About a tenth has a
    radius of 0 and is culled.

    Gaussians 2 i and 2 i + 1 have equal depths.

    opaque: fraction of Gaussians with opacity 1, whose alpha reaches its cap.
    depth: number of values per Gaussian.
    """
    sides = np.exp(rng.normal(0.9, 0.5, (count, 2)))
    opacities = np.where(rng.random(count) < opaque, 1.0, rng.uniform(0.02, 0.95, count))
    depths = rng.uniform(1, 9, count)
    depths[: count // 2 * 2 : 2] = depths[1 : count // 2 * 2 : 2]
    radii = np.where(rng.random((count, 2)) < 0.05, 0, 9).astype(np.int32)
    means2d = (rng.uniform(-0.1, 1.1, (count, 2)) * [width, height]).astype(np.float32)
    conics, values = conics_of(sides, rng.uniform(0, np.pi, count)), rng.uniform(0, 1, (count, depth))
    single = {"opacities": opacities, "depths": depths, "values": values}
    floats = {name: each.astype(np.float32) for name, each in single.items()}
    return Inputs(radii=radii, means2d=means2d, conics=conics, **floats, width=width, height=height)


def _frozen_splats(bench: CaseBench) -> list[Inputs]:
    """Inputs from the self-test's scene: its projected Gaussians as arrays."""
    camera, seen, rows = bench.camera, bench.visible, bench.splats()
    arrays = {
        "means2d": rows.means2d,
        "conics": np.where(seen[:, None], rows.conics, (1.0, 0.0, 1.0)),
        "opacities": np.where(seen, rows.opacities, 0.5),
        "depths": rows.depths,
        "values": evenly(81, (len(seen), 3), 0.0, 1.0),
    }
    radii = np.repeat(np.where(seen, 9, 0)[:, None], 2, axis=1).astype(np.int32)
    single = {name: np.ascontiguousarray(each, np.float32) for name, each in arrays.items()}
    return [Inputs(radii=radii, width=camera.width, height=camera.height, **single)]


def _launch_splats(device: Device, work: Workspace, given: Inputs) -> Read:
    names = ("radii", "means2d", "conics", "opacities", "depths", "values")
    inputs = ScreenGaussians(*(from_host(device, getattr(given, name)) for name in names))
    found = splats(device, work, inputs, given.width, given.height)

    def read() -> Arrays:
        tiles = found.tile_counts.get()
        rows = np.where(tiles[:, None] > 0, found.splats.get(), 0)
        return {"tiles": tiles, **{name: rows[:, k] for name, k in WRITTEN_SPLAT_COLUMNS.items()}}

    return read


def _twin_of_splats(given: Inputs, got: Arrays) -> dict[str, Expected]:
    conics, opacities = given.wide("conics", "opacities")
    wanted = reference_splats.splats(conics, opacities, given.radii)
    seen = wanted.drawn & (got["tiles"] > 0)
    column = {name: got[name] for name in WRITTEN_SPLAT_COLUMNS}
    whitening = np.stack([column[name] for name in ("L11", "L12", "L22")], axis=1) / WHITENING_FACTOR
    got |= {"whitening": whitening, "half extents": np.stack([column["HALF_W"], column["HALF_H"]], axis=1)}
    got["means"] = np.stack([column["PIXEL_X"] + column["SUB_X"], column["PIXEL_Y"] + column["SUB_Y"]], axis=1)[seen]
    got["values"] = np.stack([column["RED"], column["GREEN"], column["BLUE"]], axis=1)[seen]
    got["tiles of culled Gaussians"] = (got["tiles"] > 0) & ~wanted.drawn
    size = np.abs(wanted.whitenings).max(axis=1, keepdims=True, initial=0)
    logs = np.log2(opacities)
    return {
        # the bound covers three roundings; errors are relative to a row's largest entry, because l12 may be near 0
        "whitening": Expected(wanted.whitenings, 5e-7, size, seen),
        # An extent depends on the difference of two logarithms that may be nearly equal.
        # The tile test allows for an error of 0.01 px.
        "half extents": Expected(wanted.half_extents, 1e-4, 1 + wanted.half_extents, seen),
        "LOG2O": Expected(logs, 1.4e-6, 1.0, seen),  # an ulp of the logarithm changes the opacity by 1e-6
        "means": Expected(given.means2d[seen], 6e-8, 1.0),  # only fractions of a pixel are rounded
        "values": exactly(given.values[seen]),
        "tiles of culled Gaussians": exactly(np.zeros_like(got["tiles of culled Gaussians"])),
    }


SPLATS_CASE = Case(
    sizes=(1, 63, 64, 65, 0, 200),
    random=random_splats,
    launch=_launch_splats,
    twin=_twin_of_splats,
    frozen=_frozen_splats,
    digested=("tiles", *WRITTEN_SPLAT_COLUMNS),
)


def of_values(bench: CaseBench) -> StageOutcome:
    """Test the blending of VALUES_PER_GAUSSIAN values per Gaussian, with the weights of the scene's image, and the
    gradient of this blending."""
    device, camera, n = bench.device, bench.camera, bench.model.count
    size = (camera.height, camera.width)
    given, behind = evenly(91, (n, VALUES_PER_GAUSSIAN), -1.0, 1.0), evenly(92, (VALUES_PER_GAUSSIAN,), 0.0, 1.0)
    _, sure = bench.blend_reference()
    by = np.where(sure[:, :, None], evenly(93, (*size, VALUES_PER_GAUSSIAN), -1.0, 1.0), 0.0)
    by_alpha = np.where(sure, evenly(94, size, -1.0, 1.0), 0.0)
    single = (np.ascontiguousarray(each, np.float32) for each in (given, behind, by, by_alpha))
    rows, background, d_pixels, d_alpha = (upload(device, each) for each in single)
    of = ValuePass(bench.lists, bench.projected, rows, background, bench.blended)
    widths = {"means2d": 2, "conics": 3, "opacities": 0, "values": VALUES_PER_GAUSSIAN}

    def launch() -> tuple[DeviceArray, ScreenGradients]:
        pixels = bench.work.array("value_pixels", (*size, VALUES_PER_GAUSSIAN))
        pixels.fill(0.0)  # so that no result of the previous run is left
        values(device, of, pixels, first=0)
        into = ScreenGradients(
            *(bench.work.array(f"by_{name}", (n, width) if width else (n,)) for name, width in widths.items())
        )
        values_grad(device, bench.work, of, bench.counted.first_slots, d_pixels, d_alpha, into)
        return pixels, into

    def take(found: tuple[DeviceArray, ScreenGradients]) -> list[Array]:
        pixels, into = found
        return [pixels.get(), *(getattr(into, name).get() for name in widths)]

    _, outcome = bench.twice(launch, take)
    on_image = bench.splats()
    flat = reference_values.FlatGaussians(
        on_image.means2d, on_image.conics, on_image.opacities, given, on_image.depths, on_image.visible
    )
    wanted = reference_values.blend_values(flat, *size[::-1], behind)
    back = asdict(reference_values.blend_values_grad(flat, *size[::-1], behind, by, by_alpha))
    seen = on_image.visible
    pixels, *gradients = outcome.arrays
    parts = {"pixels": (pixels[sure], wanted.image[sure])}
    parts |= {f"by {name}": (got[seen], back[name][seen]) for name, got in zip(widths, gradients, strict=True)}
    return outcome.compared(parts)


SH_CENTRE = np.array([0.1, 0.2, 3.3])
"""A camera's centre, with coordinates that float32 cannot represent exactly."""


def random_harmonics(rng: Generator, count: int, degree: int | None = None, *, camera: bool | None = None) -> Inputs:
    """Random SH coefficients and directions.

    degree: the SH degree; None chooses it at random.
    camera: True for means and a camera's centre in place of directions; None chooses at random.
    """
    degree = int(rng.integers(MAX_SH_BASIS_DEGREE + 1)) if degree is None else degree
    shapes = ((count, 3), (count, 25 if degree == MAX_SH_BASIS_DEGREE else 16, 3), (count, 3))
    directions, sh, by = (rng.normal(size=shape).astype(np.float32) for shape in shapes)
    mask = np.repeat((rng.random((count, 1)) < 0.8).astype(np.int32), 2, axis=1)
    centre = SH_CENTRE if (rng.random() < 0.5 if camera is None else camera) else None
    return Inputs(directions=directions, sh=sh, by=by, mask=mask, degree=degree, centre=centre)


def _frozen_harmonics(bench: CaseBench) -> list[Inputs]:
    """SH coefficients of the highest degree, and synthetic directions."""
    n = bench.model.count
    shapes = ((n, 3), (n, (MAX_SH_BASIS_DEGREE + 1) ** 2, 3), (n, 3))
    away, sh, by = (evenly(71 + index, shape, -1.0, 1.0).astype(np.float32) for index, shape in enumerate(shapes))
    away[:, 2] += 1.5
    return [Inputs(directions=away, sh=sh, by=by, mask=None, degree=MAX_SH_BASIS_DEGREE, centre=None)]


def harmonics_inputs(device: Device, given: Inputs) -> Harmonics:
    """Upload the inputs of the SH kernels to the device."""
    mask, centre = None, None
    if given.centre is not None:
        mask, centre = upload(device, given.mask), centre_array(device, given.centre)
    return Harmonics(upload(device, given.directions), upload(device, given.sh), given.degree, mask, centre)


def launch_harmonics(device: Device, work: Workspace, given: Inputs, *, add: bool = False, start: float = -7.0) -> Read:
    """Launch harmonics and harmonics_grad.

    add: True to add to the gradients, False to overwrite them.
    start: value of all colours and gradients before the launches.
    """
    inputs = harmonics_inputs(device, given)
    shapes = ((inputs.count, 3), given.sh.shape, (inputs.count, 3))
    colours, d_sh, d_directions = (allocate(device, shape, np.float32) for shape in shapes)
    for array in (colours, d_sh, d_directions):
        array.fill(start)
    harmonics(device, inputs, colours)
    by = (colours, upload(device, given.by), HarmonicsGradients(d_sh, d_directions))
    from_centre = given.centre is not None
    by_centre = harmonics_grad(device, work, inputs, *by, add=add, add_directions=add, by_centre=from_centre)
    made = {"colours": colours, "sh": d_sh, "directions": d_directions}
    made |= {} if by_centre is None else {"centre": by_centre}
    return lambda: {name: array.get() for name, array in made.items()}


def _twin_of_harmonics(given: Inputs, _: Arrays) -> dict[str, Expected]:
    directions, sh, d_colours = given.wide("directions", "sh", "by")
    away, used = directions - (0.0 if given.centre is None else given.centre), (given.degree + 1) ** 2
    length = np.linalg.norm(away, axis=1, keepdims=True)
    unit, sh = away / length, sh[:, :used]
    basis, slopes = sh_basis(unit, given.degree), sh_basis_grad(unit, given.degree)
    colours = np.einsum("nk,nkc->nc", basis, sh)
    if given.centre is not None:
        shown = given.mask[:, :1] > 0
        colours = np.where(shown, np.maximum(colours + 0.5, 0.0), 0.0)
        d_colours = np.where(colours > 0, d_colours, 0.0)
    d_sh = np.zeros(given.sh.shape)
    d_sh[:, :used] = basis[:, :, None] * d_colours[:, None]
    by_unit = np.einsum("nkd,nkc,nc->nd", slopes, sh, d_colours)
    d_directions = (by_unit - unit * (unit * by_unit).sum(axis=1, keepdims=True)) / length
    # the bounds cover sums of up to 25 products near 1, each off by 1e-7
    wanted = {"colours": Expected(colours, 4e-6, 1.0), "sh": Expected(d_sh, 2e-6)}
    wanted["directions"] = Expected(d_directions, 2e-6) if given.degree else exactly(np.zeros_like(d_directions))
    if given.centre is not None:
        wanted["centre"] = Expected(-d_directions.sum(axis=0), 2e-6, (np.abs(by_unit) / length).sum(axis=0))
    return wanted


HARMONICS_CASE = Case(
    sizes=(1, 64, 65, 300, 63, 0, 513),
    random=random_harmonics,
    launch=launch_harmonics,
    twin=_twin_of_harmonics,
    frozen=_frozen_harmonics,
    digested=("colours", "sh", "directions"),
)
