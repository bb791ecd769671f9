# SPDX-License-Identifier: Apache-2.0
"""Self-test of the library's calls, each with its gradient.

They are projection with any view matrix, colours, splats given as arrays, and the blending of any number of values.
"""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np

from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.layouts.columns import SPLAT
from clsplat.reference import ewa as reference_ewa
from clsplat.reference import splats as reference_splats
from clsplat.reference import values as reference_values
from clsplat.reference.sh import sh_basis_grad
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
from clsplat.stages.harmonics import MAX_SH_BASIS_DEGREE, Harmonics, HarmonicsGradients, harmonics, harmonics_grad
from clsplat.stages.project import Projected
from clsplat.stages.splats import ScreenGaussians, ScreenGradients, splats
from clsplat.stages.values import ValuePass, values, values_grad

VALUES_PER_GAUSSIAN = 5
"""Values per Gaussian: more than blend.cl supports."""
WRITTEN_SPLAT_COLUMNS = {name: k for k, name in enumerate(SPLAT) if name != "UNUSED"}


def of_ewa(bench: CaseBench) -> StageOutcome:
    """Test EWA projection with a view matrix that is not a rotation, with compensations and synthetic gradients."""
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
    wrong = int((off[both] > 1).sum()) + max(int((off > 0).sum()) - 2, 0)  # for sides near a whole pixel
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


def of_harmonics(bench: CaseBench) -> StageOutcome:
    """Test colours of the highest degree in synthetic directions."""
    device, n, coefficients = bench.device, bench.model.count, (MAX_SH_BASIS_DEGREE + 1) ** 2
    away, sh, by = (
        evenly(71 + index, shape, -1.0, 1.0).astype(np.float32)
        for index, shape in enumerate(((n, 3), (n, coefficients, 3), (n, 3)))
    )
    away[:, 2] += 1.5
    given = Harmonics(upload(device, away), upload(device, sh), MAX_SH_BASIS_DEGREE)

    def launch() -> list[DeviceArray]:
        found = [bench.work.array(f"sh_{k}", array.shape) for k, array in enumerate((by, sh, away))]
        harmonics(device, given, found[0])
        harmonics_grad(device, bench.work, given, found[0], upload(device, by), HarmonicsGradients(*found[1:]))
        return found

    def take(found: list[DeviceArray]) -> list[Array]:
        return [array.get() for array in found]

    _, outcome = bench.twice(launch, take)
    length = np.linalg.norm(away.astype(np.float64), axis=1, keepdims=True)
    unit, exact, back = away / length, sh.astype(np.float64), by.astype(np.float64)
    basis = sh_basis(unit, MAX_SH_BASIS_DEGREE)
    by_unit = np.einsum("nkd,nkc,nc->nd", sh_basis_grad(unit, MAX_SH_BASIS_DEGREE), exact, back)
    by_direction = (by_unit - unit * (unit * by_unit).sum(axis=1, keepdims=True)) / length
    wanted = (np.einsum("nk,nkc->nc", basis, exact), basis[:, :, None] * back[:, None], by_direction)
    names = ("colours", "by coefficients", "by directions")
    return outcome.compared(dict(zip(names, zip(outcome.arrays, wanted, strict=True), strict=True)))


def of_splats(bench: CaseBench) -> StageOutcome:
    """Test splats of the scene's projected Gaussians, given as arrays."""
    device, camera, seen = bench.device, bench.camera, bench.visible
    rows = bench.splats()
    count = len(seen)
    radii = np.repeat(np.where(seen, 9, 0)[:, None], 2, axis=1).astype(np.int32)
    conics = np.where(seen[:, None], rows.conics, (1.0, 0.0, 1.0)).astype(np.float32)
    opacities = np.where(seen, rows.opacities, 0.5).astype(np.float32)
    arrays = (radii, rows.means2d, conics, opacities, rows.depths, evenly(81, (count, 3), 0.0, 1.0))
    kinds = (np.int32, *[np.float32] * 5)
    given = ScreenGaussians(
        *(upload(device, np.ascontiguousarray(each, kind)) for each, kind in zip(arrays, kinds, strict=True))
    )

    work = Workspace(device)  # so that the scene's own splats are not overwritten

    def launch() -> Projected:
        return splats(device, work, given, camera.width, camera.height)

    def take(found: Projected) -> list[Array]:
        tiles = found.tile_counts.get()
        rows = np.where(tiles[:, None] > 0, found.splats.get(), 0)
        return [tiles, *(rows[:, k] for k in WRITTEN_SPLAT_COLUMNS.values())]

    _, outcome = bench.twice(launch, take)
    tiles, *columns = outcome.arrays
    both = seen & (tiles > 0)
    wrong = max(int((seen != (tiles > 0)).sum()) - 2, 0)  # for ellipses that end at a tile's first pixel
    column = {name: values[both] for name, values in zip(WRITTEN_SPLAT_COLUMNS, columns, strict=True)}
    wanted = reference_splats.splats(conics.astype(np.float64), opacities.astype(np.float64), radii)
    whitening = np.stack([column[name] for name in ("L11", "L12", "L22")], axis=1) / WHITENING_FACTOR
    half = np.stack([column["HALF_W"], column["HALF_H"]], axis=1)
    parts = {"whitening": (whitening, wanted.whitenings[both]), "half extents": (half, wanted.half_extents[both])}
    logs = (column["LOG2O"], np.log2(opacities[both].astype(np.float64)))
    return outcome.compared({**parts, "log2 opacities": logs}, shown=wrong)


def of_values(bench: CaseBench) -> StageOutcome:
    """Test the blending of VALUES_PER_GAUSSIAN values per Gaussian with the weights of the scene's image, and synthetic
    gradients."""
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
        pixels.fill(0.0)  # blend.cl makes the first three
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


LIBRARY_CASES = {"ewa": of_ewa, "harmonics": of_harmonics, "splats": of_splats, "values": of_values}
