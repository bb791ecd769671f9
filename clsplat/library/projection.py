# SPDX-License-Identifier: Apache-2.0
"""Projection of Gaussians to the images of cameras, and its vector-Jacobian product."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.arrays import Float32
from clsplat.device.buffers import DeviceArray, Hosted, from_host, hosted
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.library.checks import choice, floats, gradient, matrices, number, sizes
from clsplat.library.session import Session, session_of
from clsplat.stages.ewa import (
    MODELS,
    Ewa,
    EwaCamera,
    EwaGradients,
    EwaInputs,
    camera_gradients,
    ewa,
    ewa_array,
    ewa_grad,
)

_GIVEN = {"means2d": 2, "depths": None, "conics": 3, "compensations": None}
"""Outputs that have gradients, and how many numbers each is."""


class ProjectedView:
    """Gaussians on the image of one camera, with all that the gradient needs, until it is dropped.

    gaussians: on the session's device; they must not change before the last `gradient`. `arrays` has the results on the
    device. Calls have to hold the session's lock.
    """

    def __init__(self, session: Session, gaussians: EwaInputs, camera: EwaCamera, *, compensated: bool = False) -> None:
        device, n = session.device, gaussians.count
        self._session, self._gaussians, self.camera = session, gaussians, camera
        self._hosted: dict[str, Hosted] = {
            "radii": hosted(device, (n, 2), np.int32),
            "means2d": hosted(device, (n, 2)),
            "depths": hosted(device, (n,)),
            "conics": hosted(device, (n, 3)),
            **({"compensations": hosted(device, (n,))} if compensated else {}),
        }
        self.arrays = Ewa(**{name: array.array for name, array in self._hosted.items()})
        self._camera_array = ewa_array(device, camera)
        ewa(device, gaussians, camera, self._camera_array, self.arrays)

    def get(self, name: str) -> NDArray[Any]:
        """One of the results on the host, by its name in `Ewa`: the same memory each time. Waits for the device."""
        return self._hosted[name].get()

    def gradient(
        self, gradients: EwaGradients, *, add: bool = False, by_camera: bool = False, **given: DeviceArray | None
    ) -> DeviceArray | None:
        """Fill `gradients` as `stages.ewa.ewa_grad` does, from those that are given by means2d, depths, conics and
        compensations; by_camera: the result is that by the camera (16,)."""
        return ewa_grad(
            self._session.device,
            self._session.scratch,
            self._gaussians,
            self.camera,
            self._camera_array,
            self.arrays,
            gradients,
            add=add,
            by_camera=by_camera,
            **given,
        )


class HostedGradients(NamedTuple):
    """Gradients by Gaussians: arrays for `EwaGradients`, and what they are on the host by the names of arguments."""

    arrays: EwaGradients
    hosted: dict[str, Hosted]


def hosted_gradients(device: Device, count: int, *, covariances: bool) -> HostedGradients:
    """Room for gradients by `count` Gaussians."""
    shapes: dict[str, tuple[int, ...]] = {"means": (count, 3)}
    shapes |= {"covars": (count, 6)} if covariances else {"quaternions": (count, 4), "scales": (count, 3)}
    room = {name: hosted(device, shape) for name, shape in shapes.items()}
    names = {"covars": "covariances"}
    return HostedGradients(EwaGradients(**{names.get(name, name): each.array for name, each in room.items()}), room)


@dataclass(frozen=True, eq=False)
class Projection:
    """N Gaussians on the images of C cameras.

    radii (C, N, 2) int32: whole pixels, 0 where culled; means2d (C, N, 2): pixels, the first one's middle at 0.5;
    depths (C, N): z in the camera, world units; conics (C, N, 3): a, b, c of the inverse covariance, 1 / px^2;
    compensations (C, N), 0 to 1, or None. Rows of what is culled are zero.
    """

    radii: NDArray[np.int32]
    means2d: Float32
    depths: Float32
    conics: Float32
    compensations: Float32 | None
    _views: list[ProjectedView]
    _session: Session
    _covariances: str
    """The shape that they were given in: empty, "upper" or "full"."""

    def vjp(
        self,
        means2d: ArrayLike | None = None,
        depths: ArrayLike | None = None,
        conics: ArrayLike | None = None,
        compensations: ArrayLike | None = None,
    ) -> dict[str, Float32]:
        """The vector-Jacobian product: gradients by `means` (N, 3), `quaternions` (N, 4) and `scales` (N, 3), or
        `covars` in the shape that they were given in, `viewmats` (C, 4, 4), of any of their first three rows' numbers,
        and `intrinsics` (C, 3, 3), of fx, fy, cx and cy.

        The arguments are gradients by the outputs, of their shapes, and None is 0; by b of a conic as the one number
        that it is. Of covars (N, 6) an off-diagonal number has the gradient of both its places; of (N, 3, 3) each
        place its own, half of that. What is culled has no gradient. Raises InputError for another shape, and for
        compensations that were not asked for.
        """
        values = {"means2d": means2d, "depths": depths, "conics": conics, "compensations": compensations}
        if compensations is not None and self.compensations is None:
            raise InputError("compensations: got a gradient, but they were not asked for (calc_compensations)")
        shape = self.depths.shape
        arrays = {
            name: array
            for name, width in _GIVEN.items()
            if (array := gradient(name, values[name], (*shape, width) if width else shape)) is not None
        }
        session, device = self._session, self._session.device
        count, viewmats, intrinsics = shape[1], [], []
        with session.lock:
            room = hosted_gradients(device, count, covariances=bool(self._covariances))
            for unseen in room.arrays.arrays if not self._views else ():
                unseen.fill(0.0)
            for index, view in enumerate(self._views):
                given = {name: from_host(device, array[index]) for name, array in arrays.items()}
                by_camera = view.gradient(room.arrays, add=index > 0, by_camera=True, **given)
                assert by_camera is not None
                by_viewmat, by_intrinsics = camera_gradients(by_camera.get())
                viewmats.append(by_viewmat)
                intrinsics.append(by_intrinsics)
            result = {name: np.asarray(array.get(), np.float32) for name, array in room.hosted.items()}
        if self._covariances == "full":
            result["covars"] = full_gradient(result["covars"])
        result["viewmats"] = np.array(viewmats, np.float32).reshape(-1, 4, 4)
        result["intrinsics"] = np.array(intrinsics, np.float32).reshape(-1, 3, 3)
        return result


def fully_fused_projection(
    means: ArrayLike,
    covars: ArrayLike | None,
    quaternions: ArrayLike | None,
    scales: ArrayLike | None,
    viewmats: ArrayLike,
    intrinsics: ArrayLike,
    width: int,
    height: int,
    *,
    eps2d: float = 0.3,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    calc_compensations: bool = False,
    camera_model: str = "pinhole",
    opacities: ArrayLike | None = None,
    device: Device | str | None = None,
) -> Projection:
    """Project Gaussians to the images of C cameras, by the conventions of gsplat's function of that name.

    means (N, 3): world units. Either quaternions (N, 4), w x y z, of any length but 0, and scales (N, 3), which are
    standard deviations in world units, or covars (N, 6), upper triangles xx, xy, xz, yy, yz, zz, or (N, 3, 3); the
    others are None. viewmats (C, 4, 4) or (4, 4): camera from world; intrinsics (C, 3, 3) or (3, 3): pixels, a skew
    is not looked at; width, height: pixels. eps2d: px^2, added to the diagonal of each projected covariance;
    near_plane, far_plane: world units; radius_clip: pixels, what has no larger radius is culled; calc_compensations:
    also the square root of the covariance's determinant without eps2d over that with it; camera_model: pinhole, ortho
    or fisheye (equidistant); opacities (N,), 0 to 1: with them radii end where alpha is 1/255, and what is fainter is
    culled.
    Float32 arrays are read in place, and must not change before the last `vjp`.

    Raises InputError, which names the argument, for wrong shapes and numbers that are not finite, DeviceError for a
    device that is not there. Zwicker et al., EWA splatting, 2002; docs/gradients.md, section 22.
    """
    given_means = floats("means", means, ("N", 3))
    count = len(given_means)
    cameras = checked_cameras(
        viewmats,
        intrinsics,
        width,
        height,
        near_plane=near_plane,
        far_plane=far_plane,
        eps2d=eps2d,
        radius_clip=radius_clip,
        camera_model=camera_model,
    )
    shapes, covariances = checked_shapes(count, covars, quaternions, scales)
    if opacities is not None:
        shapes["opacities"] = floats("opacities", opacities, (count,))
    session = session_of(device)
    with session.lock:
        arrays = {name: from_host(session.device, array) for name, array in {"means": given_means, **shapes}.items()}
        inputs = EwaInputs(**arrays)
        views = [ProjectedView(session, inputs, camera, compensated=calc_compensations) for camera in cameras]

        def of_all(name: str, *width: int) -> NDArray[Any]:
            kind = np.int32 if name == "radii" else np.float32
            return stacked([view.get(name) for view in views], np.empty((count, *width), kind))

        return Projection(
            of_all("radii", 2),
            of_all("means2d", 2),
            of_all("depths"),
            of_all("conics", 3),
            of_all("compensations") if calc_compensations else None,
            views,
            session,
            covariances,
        )


def checked_cameras(
    viewmats: ArrayLike,
    intrinsics: ArrayLike,
    width: int | Sequence[int],
    height: int | Sequence[int],
    *,
    near_plane: float,
    far_plane: float,
    eps2d: float,
    radius_clip: float,
    camera_model: str,
) -> list[EwaCamera]:
    """The cameras of viewmats (C, 4, 4) and intrinsics (C, 3, 3), or of one of each, (4, 4) and (3, 3); width, height:
    pixels of all cameras or of each. Raises InputError, which names the argument."""
    planes = checked_planes(near_plane, far_plane, eps2d, radius_clip, camera_model)
    poses = matrices("viewmats", viewmats, 4, "C")
    count = len(poses)
    lenses = matrices("intrinsics", intrinsics, 3, count)
    if len(lenses) != count:
        raise InputError(f"intrinsics has {len(lenses)} matrices, expected {count}, one for each of viewmats")
    if not (lenses[:, [0, 1], [0, 1]] != 0).all():
        raise InputError("intrinsics: a focal length is 0, expected those of a camera")
    listed = zip(poses, lenses, sizes("width", width, count), sizes("height", height, count), strict=True)
    return [EwaCamera(*camera, *planes, camera_model) for camera in listed]


def checked_planes(
    near_plane: float, far_plane: float, eps2d: float, radius_clip: float, camera_model: str
) -> tuple[float, float, float, float]:
    """Settings of `EwaCamera`, but for the model. Raises InputError, which names the argument."""
    choice("camera_model", camera_model, tuple(MODELS))
    near, far = number("near_plane", near_plane, -np.inf), number("far_plane", far_plane, -np.inf)
    if not near < far:
        raise InputError(f"near_plane is {near_plane} and far_plane {far_plane}, expected the second to be larger")
    most = float(np.finfo(np.float32).max)
    return near, far, number("eps2d", eps2d, 0.0, most), number("radius_clip", radius_clip, 0.0, most)


def check_given(covars: object, quaternions: object, scales: object) -> None:
    """Raise InputError, which names the argument, unless there are covars or the other two, and None for the rest."""
    if covars is None and (quaternions is None or scales is None):
        missing = "quaternions" if quaternions is None else "scales"
        raise InputError(f"{missing} is None, expected an array, as covars is None too")
    if covars is not None and (quaternions is not None or scales is not None):
        raise InputError("covars: expected either these, or quaternions and scales")


def checked_shapes(
    count: int, covars: ArrayLike | None, quaternions: ArrayLike | None, scales: ArrayLike | None
) -> tuple[dict[str, Float32], str]:
    """Arrays of `EwaInputs` for what shape the Gaussians have, and of covars "upper" or "full", how they were given;
    empty of quaternions and scales. Raises InputError, which names the argument."""
    check_given(covars, quaternions, scales)
    if quaternions is not None and scales is not None:
        return {
            "quaternions": floats("quaternions", quaternions, (count, 4)),
            "scales": floats("scales", scales, (count, 3)),
        }, ""
    assert covars is not None, "check_given"
    given = floats("covars", covars, (count, 6), (count, 3, 3))
    if given.ndim == 2:
        return {"covariances": given}, "upper"
    flat = given.reshape(count, 9)
    upper = 0.5 * (flat[:, [0, 1, 2, 4, 5, 8]] + flat[:, [0, 3, 6, 4, 7, 8]])
    return {"covariances": np.ascontiguousarray(upper, np.float32)}, "full"


def full_gradient(upper: Float32) -> Float32:
    """Gradients by the nine numbers of matrices from those by their upper triangles."""
    halves = upper * np.array([1, 0.5, 0.5, 1, 0.5, 1], np.float32)
    return np.asarray(halves[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3), np.float32)


def stacked(arrays: list[NDArray[Any]], each: NDArray[Any] | None = None) -> NDArray[Any]:
    """One array of those of all cameras, of one camera its own memory; `each` is one like them where there may be no
    camera."""
    if len(arrays) == 1:
        return arrays[0][None]
    return np.stack(arrays) if arrays or each is None else np.zeros((0, *each.shape), each.dtype)
