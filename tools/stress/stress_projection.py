# SPDX-License-Identifier: Apache-2.0
"""Compare projection and its gradient with the twin in 80-bit floats, for each of many Gaussians."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stress_cases import DEGREE, Cases

from clsplat.camera import Camera
from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import PLAIN_SLOTS, SPLAT
from clsplat.reference.project import (
    ALPHA_MIN,
    PARAMETER_NAMES,
    ProjectedGradients,
    ProjectedTwin,
    project,
    project_grad,
    view_directions,
)
from clsplat.reference.render import parameters
from clsplat.spherical_harmonics import sh_basis
from clsplat.stages import device_camera, device_gaussians
from clsplat.stages import project as stages_project
from clsplat.stages.device_gaussians import DeviceGaussians

Array = NDArray[Any]
WHITEN2 = np.log2(np.e) / 2
TINY = 1e-36
FIELDS = tuple(name for name in SPLAT if name != "UNUSED")


@dataclass(frozen=True, eq=False)
class Outcome:
    """Comparison of a batch with the twin.

    errors: errors (n,) by name, as in ERRORS; NaN where there is nothing to compare.
    norms: by parameter group, the sums of |difference|^2 and |wanted|^2 of the gradients.
    shown: (n,), True for Gaussians that the kernels show.
    broken: by description, the number of Gaussians that are not finite, wrongly shown or wrongly culled.
    """

    errors: dict[str, Array]
    norms: dict[str, tuple[float, float]]
    shown: NDArray[np.bool_]
    broken: dict[str, int]


def random_sums(rng: np.random.Generator, count: int) -> Array:
    """Random sums (n, 9) like those of blending's gradient: moments of random weights at points within the ellipse."""
    points = 6
    radius, angle = 1.5 * np.sqrt(rng.random((count, points))), rng.uniform(0, 2 * np.pi, (count, points))
    u, v = radius * np.cos(angle), radius * np.sin(angle)
    g = rng.normal(size=(count, points))
    moments = [g, g * u, g * v, g * u * u, g * u * v, g * v * v]
    sums = np.column_stack([*(moment.sum(axis=1) for moment in moments), rng.normal(size=(count, 3))])
    return sums.astype(np.float32)


def there_and_back(
    device: Device, work: Workspace, cases: Cases, sums: Array, *, by_lens: DeviceArray | None = None
) -> tuple[stages_project.Projected, DeviceGaussians, DeviceArray]:
    """Run the kernels of projection and, with the sums as slots, of its gradient.

    by_lens: filled with the gradients with respect to the lens.
    Returns the splats, the gradients, and the gradients (n, 2) with respect to the means on the image. Values that the
    kernels have not written are NaN.
    """
    gaussians = device_gaussians.upload_gaussians(device, cases.gaussians)
    camera = upload(device, device_camera.pack_camera(cases.camera))
    count = len(cases.gaussians)
    work.array("splats", (count, len(SPLAT))).fill(np.nan)
    projected = stages_project.project(device, work, gaussians, cases.camera, camera)
    gradients = device_gaussians.allocate_gaussians(device, count, gaussians.coefficients)
    for array in gradients.arrays.values():
        array.fill(np.nan)
    screen = stages_project.Screen(work.array("screen", (count, 2)))
    screen.gradients.fill(np.nan)
    slots = stages_project.Slots(upload(device, sums))
    assert sums.shape[1] == PLAIN_SLOTS.floats
    view = stages_project.ViewSlots(camera, projected, slots)
    stages_project.project_grad(device, gaussians, view, gradients, screen, by_lens=by_lens)
    return projected, gradients, screen.gradients


def exact(gaussians: Gaussians) -> dict[str, Array]:
    """The parameters in 80-bit floats."""
    return {name: array.astype(np.longdouble) for name, array in parameters(gaussians).items()}


def in_order(arrays: Mapping[str, Array]) -> tuple[Array, Array, Array, Array, Array]:
    """The parameters in the order of the twin's arguments."""
    means, quaternions, log_scales, opacity_logits, sh = (arrays[name] for name in PARAMETER_NAMES)
    return means, quaternions, log_scales, opacity_logits, sh


def on_image(wanted: ProjectedTwin, sums: Array) -> ProjectedGradients:
    """Gradients with respect to the projected Gaussians, from the sums: eqs. (50), (29)."""
    g, gu, gv, uu, uv, vv = sums[:, :6].astype(np.longdouble).T
    l11, l12, l22 = wanted.whitening.T  # the sums are of u' = -k u
    k = np.sqrt(np.longdouble(WHITEN2))
    d_means2d = -np.stack([l11 * gu, l12 * gu + l22 * gv], axis=1) / k
    xx = l11 * l11 * uu
    xy = l11 * (l12 * uu + l22 * uv)
    yy = l12 * l12 * uu + 2 * l12 * l22 * uv + l22 * l22 * vv
    d_covariances = np.stack([xx, xy, yy], axis=1) / (2 * k * k)
    with np.errstate(all="ignore"):
        d_opacities = np.where(wanted.visible, g / wanted.opacities, 0)
    return ProjectedGradients(d_means2d, d_covariances, d_opacities, sums[:, 6:9].astype(np.longdouble))


def wanted_gradients(
    arrays: Mapping[str, Array], camera: Camera, wanted: ProjectedTwin, sums: Array
) -> tuple[dict[str, Array], Array]:
    """The twin's gradients with respect to the parameters, and to the means on the image, from the sums."""
    image = on_image(wanted, sums)
    g = sums[:, 0].astype(np.longdouble)
    with np.errstate(all="ignore"):
        by = project_grad(arrays, camera, DEGREE, wanted, image)
        # 1 - o would have only rounding errors where o is close to 1
        rest = 1 / (1 + np.exp(arrays["opacity_logits"]))
    by["opacity_logits"] = np.where(wanted.visible, g * rest, 0)
    logs = arrays["log_scales"]
    by["quaternions"][(logs == logs[:, :1]).all(axis=1)] = 0  # a ball: the twin's gradient is only rounding
    return by, image.means2d


def least_exponent(wanted: ProjectedTwin, camera: Camera) -> Array:
    """The least exponent q (n,) over the rectangle of the pixel centres. No pixel has a larger alpha than there."""
    low = 0.5 - wanted.means2d
    high = np.array([camera.width - 0.5, camera.height - 0.5]) - wanted.means2d
    a, b, c = wanted.conics.T
    inside = ((low <= 0) & (high >= 0)).all(axis=1)
    best = np.full(len(a), np.inf, np.longdouble)
    with np.errstate(all="ignore"):
        for x in (low[:, 0], high[:, 0]):
            y = np.clip(-b * x / c, low[:, 1], high[:, 1])
            best = np.fmin(best, a * x * x + 2 * b * x * y + c * y * y)
        for y in (low[:, 1], high[:, 1]):
            x = np.clip(-b * y / a, low[:, 0], high[:, 0])
            best = np.fmin(best, a * x * x + 2 * b * x * y + c * y * y)
    return np.where(inside, 0, best)


def limits_of_kernels(arrays: Mapping[str, Array], wanted: ProjectedTwin) -> NDArray[np.bool_]:
    """Mask (n,) of the Gaussians that the kernels may cull because of float32's range, although the twin shows them
    (docs/gradients.md, section 10)."""
    norm2 = (arrays["quaternions"] ** 2).sum(axis=1)
    a, b, c = wanted.conics.T
    with np.errstate(all="ignore"):
        det = 1 / (a * c - b * b)
    large = (wanted.covariances[:, [0, 2]] > 0.99e30).any(axis=1) | (np.abs(wanted.whitening).max(axis=1) < 1e-14)
    culled: NDArray[np.bool_] = ~(norm2 > 1.01e-30) | ~(norm2 < 0.99e30) | large | ~(det < 0.99e30)
    return culled


def undecided(arrays: Mapping[str, Array], camera: Camera) -> NDArray[np.bool_]:
    """Mask (n,) of the Gaussians that are within float32's errors of a threshold of (13): the near plane or 1/255."""
    z = (arrays["means"] @ camera.rotation.T + camera.translation)[:, 2]
    reach = np.abs(arrays["means"]).max(axis=1) + np.abs(camera.translation).max()
    with np.errstate(all="ignore"):
        opacity = 1 / (1 + np.exp(-arrays["opacity_logits"]))
    at_near = np.abs(z - camera.near) <= 1e-7 * camera.near + 1e-13 * reach
    near: NDArray[np.bool_] = at_near | (np.abs(opacity / ALPHA_MIN - 1) < 1e-5)
    return near


def compare(device: Device, cases: Cases, rng: np.random.Generator, *, finite_only: bool = False) -> Outcome:
    """Compare projection and gradient of a batch with the twin. ERRORS explains the errors.

    finite_only: only count results that are not finite.
    """
    count = len(cases.gaussians)
    sums = random_sums(rng, count)
    projected, written, on_screen = there_and_back(device, Workspace(device), cases, sums)
    gradients, screen = device_gaussians.download_gaussians(written), on_screen.get()
    splats, shown = projected.splats.get(), projected.tile_counts.get() > 0
    with np.errstate(invalid="ignore"):
        columns = {name: splats[:, SPLAT.index(name)].astype(np.longdouble) for name in FIELDS}
    finite = np.isfinite(np.stack(list(columns.values()))).all(axis=0) & np.isfinite(screen).all(axis=1)
    for name in PARAMETER_NAMES:
        finite &= np.isfinite(getattr(gradients, name)).reshape(count, -1).all(axis=1)
    not_finite = int((shown & ~finite).sum())
    if finite_only:
        return Outcome({}, {}, shown, {"not finite": not_finite})
    arrays, camera = exact(cases.gaussians), cases.camera
    wanted = project(*in_order(arrays), camera, DEGREE)
    skipped = undecided(arrays, camera)
    with np.errstate(all="ignore"):
        budget = 2 * np.log(wanted.opacities / ALPHA_MIN)
    # Ellipses that barely reach the image are left out: their largest alphas there are within 2 % of 1/255.
    reaches = wanted.visible & (least_exponent(wanted, camera) < budget - 0.04)
    missing = reaches & ~shown & ~skipped & ~limits_of_kernels(arrays, wanted)
    for i in np.flatnonzero(missing):  # an ellipse may pass between pixel centres
        found = wanted.footprint(int(i), camera.width, camera.height)
        missing[i] = found is not None and bool((found.raw >= ALPHA_MIN * 1.02).any())
    broken = {
        "not finite": not_finite,
        "shown, not visible": int((shown & ~wanted.visible & ~skipped).sum()),
        "culled, visible": int(missing.sum()),
    }
    both = shown & wanted.visible & finite
    errors = _forward_errors(columns, arrays, camera, wanted)
    by, d_screen = wanted_gradients(arrays, camera, wanted, sums)
    norms = {}
    for name, got, want in (
        *((n, getattr(gradients, n), by[n]) for n in PARAMETER_NAMES),
        ("screen", screen, d_screen),
    ):
        difference = (got.astype(np.longdouble) - want).reshape(count, -1)
        size = np.sqrt((want.reshape(count, -1) ** 2).sum(axis=1))
        off = np.sqrt((difference**2).sum(axis=1))
        with np.errstate(all="ignore"):
            # no relative errors below the smallest normal float, which a sigmoid's gradient reaches at a logit of 87
            errors[f"d {name}"] = np.where(size > TINY, off / size, np.where(off > TINY, np.inf, 0))
        norms[name] = (float((off[both] ** 2).sum()), float((size[both] ** 2).sum()))
    return Outcome({name: np.where(both, e, np.nan).astype(float) for name, e in errors.items()}, norms, shown, broken)


ERRORS = {
    "position": "mean on the image: in pixels; for means beyond 10,000 pixels, per 10,000 pixels",
    "shape": "whitening: largest diagonal entry of W W_exact^-1 - 1",
    "offset": "whitened offset (u, v) of the farthest pixel in the ellipse: absolute",
    "depth": "relative",
    "opacity": "relative",
    "extent": "half sides of the box: relative",
    "colour": "relative to 0.5 + sum |Y_k h_k|",
    **{f"d {name}": "gradient of a Gaussian: relative error in norm" for name in (*PARAMETER_NAMES, "screen")},
}


def _forward_errors(
    columns: Mapping[str, Array], arrays: Mapping[str, Array], camera: Camera, wanted: ProjectedTwin
) -> dict[str, Array]:
    with np.errstate(all="ignore"):
        k = np.sqrt(np.longdouble(WHITEN2))
        x, y = columns["PIXEL_X"] + columns["SUB_X"], columns["PIXEL_Y"] + columns["SUB_Y"]
        away = np.hypot(x - wanted.means2d[:, 0], y - wanted.means2d[:, 1])
        l11, l12, l22 = (columns[name] / k for name in ("L11", "L12", "L22"))
        w11, w12, w22 = wanted.whitening.T
        e11, e22 = np.abs(l11 / w11 - 1), np.abs(l22 / w22 - 1)
        e12 = np.abs((l12 - l11 / w11 * w12) / w22)
        reach = np.sqrt(2 * np.log(wanted.opacities / ALPHA_MIN))
        mean_y = wanted.means2d[:, 1]
        farthest = np.maximum(np.abs(0.5 - mean_y), np.abs(camera.height - 0.5 - mean_y))
        v = np.minimum(reach, farthest * w22)
        directions, _ = view_directions(arrays["means"], camera)
        weights = np.abs(sh_basis(directions, DEGREE)[:, :, None] * arrays["sh"]).sum(axis=1)
        colours = np.stack([columns[name] for name in ("RED", "GREEN", "BLUE")], axis=1)
        half = np.stack([columns["HALF_W"], columns["HALF_H"]], axis=1)
        return {
            "position": away / np.maximum(1, np.abs(wanted.means2d).max(axis=1) / 1e4),
            "shape": np.maximum(e11, e22),
            "offset": np.maximum(e11 * reach + e12 * v, e22 * v),
            "depth": np.abs(columns["DEPTH"] / wanted.depths - 1),
            "opacity": np.abs(2 ** columns["LOG2O"] / wanted.opacities - 1),
            # a budget close to 0 has only rounding errors, and the Gaussian is invisible
            "extent": np.where(reach > 0.1, np.abs(half / wanted.half_extents - 1).max(axis=1), 0),
            "colour": (np.abs(colours - wanted.colors) / (0.5 + weights)).max(axis=1),
        }
