# SPDX-License-Identifier: Apache-2.0
"""Projection of Gaussians to the images of cameras, and its vector-Jacobian product."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.arrays import Float32
from clsplat.device.buffers import DeviceArray, Hosted, from_host, hosted
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.library.checks import choice, floats, gradient, matrices, number, sizes
from clsplat.library.session import LibrarySession, session_of
from clsplat.stages.ewa import (
    EWA_CAMERA_MODELS,
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

_PROJECTED_ARRAY_WIDTHS = {"means2d": 2, "depths": None, "conics": 3, "compensations": None}
"""Outputs of the projection that have gradients, with the length of their last axis; None if they have one number per
Gaussian."""


class ProjectedView:
    """Gaussians projected to a camera's image. The object keeps memory for its gradient until it is deleted.

    gaussians: arrays on the session's device, which must not change before the last `gradient`.
    compensated: also compute the opacity factors "compensations" for the low-pass filter.

    `arrays` has the results on the device. The caller must hold the session's lock.
    """

    def __init__(
        self, session: LibrarySession, gaussians: EwaInputs, camera: EwaCamera, *, compensated: bool = False
    ) -> None:
        device, n = session.device, gaussians.count
        self._session, self._gaussians, self._camera = session, gaussians, PlacedEwaCamera.on(device, camera)
        radii, means2d = hosted(device, (n, 2), np.int32), hosted(device, (n, 2))
        depths, conics = hosted(device, (n,)), hosted(device, (n, 3))
        self._hosted = {"radii": radii, "means2d": means2d, "depths": depths, "conics": conics}
        self.arrays = Ewa(radii.array, means2d.array, depths.array, conics.array)
        if compensated:
            compensations = self._hosted["compensations"] = hosted(device, (n,))
            self.arrays = replace(self.arrays, compensations=compensations.array)
        ewa(device, gaussians, self._camera, self.arrays)

    def get(self, name: str) -> NDArray[Any]:
        """Return an array of the projection on the host, not as a copy. Waits for the device.

        name: "radii", "means2d", "depths", "conics" or "compensations".
        """
        return self._hosted[name].get()

    def gradient(
        self, given: EwaImageGradients, gradients: EwaGradients, *, add: bool = False, by_camera: bool = False
    ) -> DeviceArray | None:
        """Compute gradients with respect to the Gaussians into the arrays `gradients`.

        given: gradients with respect to the projected arrays.
        add: True adds to the values in the arrays; False replaces them.
        by_camera: also return the gradient (16,) with respect to the camera.
        """
        session, view = self._session, (self._gaussians, self._camera, self.arrays)
        return ewa_grad(session.device, session.scratch, *view, given, gradients, add=add, by_camera=by_camera)


def image_gradients(device: Device, given: Mapping[str, Float32]) -> EwaImageGradients:
    """Upload gradients with respect to projected Gaussians.

    given: gradients by the names "means2d", "depths", "conics" and "compensations"; an absent one counts as 0.
    """

    def at(name: str) -> DeviceArray | None:
        return from_host(device, given[name]) if name in given else None

    return EwaImageGradients(at("means2d"), at("depths"), at("conics"), at("compensations"))


class HostedGradients(NamedTuple):
    """Gradients with respect to Gaussians.

    arrays: the gradients on the device.
    hosted: the same gradients by argument name, to be read on the host.
    """

    arrays: EwaGradients
    hosted: dict[str, Hosted]


def hosted_gradients(device: Device, count: int, *, covariances: bool) -> HostedGradients:
    """Allocate the arrays for gradients with respect to `count` Gaussians.

    covariances: True for gradients with respect to covariances instead of quaternions and scales.
    """
    means = hosted(device, (count, 3))
    if covariances:
        covars = hosted(device, (count, 6))
        arrays = EwaGradients(means.array, covariances=covars.array)
        return HostedGradients(arrays, {"means": means, "covars": covars})
    quaternions, scales = hosted(device, (count, 4)), hosted(device, (count, 3))
    arrays = EwaGradients(means.array, quaternions.array, scales.array)
    return HostedGradients(arrays, {"means": means, "quaternions": quaternions, "scales": scales})


@dataclass(frozen=True, eq=False)
class Projection:
    """N Gaussians projected to the images of C cameras. The rows of culled Gaussians are zero.

    Attributes
    ----------
    radii : (C, N, 2) int32
        Half sides of a Gaussian's bounding box in whole pixels; 0 if it is culled.
    means2d : (C, N, 2) float32
        Pixels; the first pixel's centre is at 0.5.
    depths : (C, N) float32
        z in the camera's axes, in world units.
    conics : (C, N, 3) float32
        a, b, c of the inverse covariance, 1 / px^2.
    compensations : (C, N) float32 or None
        Opacity factors for the low-pass filter, 0 to 1.
    """

    radii: NDArray[np.int32]
    means2d: Float32
    depths: Float32
    conics: Float32
    compensations: Float32 | None
    _views: list[ProjectedView]
    _session: LibrarySession
    _covariances: str
    """Layout of the caller's covariances: "upper", "full", or empty if there are none."""

    def vjp(
        self,
        means2d: ArrayLike | None = None,
        depths: ArrayLike | None = None,
        conics: ArrayLike | None = None,
        compensations: ArrayLike | None = None,
    ) -> dict[str, Float32]:
        """Compute the vector-Jacobian product.

        Parameters
        ----------
        means2d, depths, conics, compensations : array_like, optional
            Gradients of the loss with respect to the outputs, in their shapes. None means 0. The entry b of a conic
            fills two places of a matrix, but counts as one variable.

        Returns
        -------
        dict
            float32 gradients by argument name. "means" is (N, 3). "quaternions" (N, 4) and "scales" (N, 3), or "covars"
            in the given shape. In "viewmats" (C, 4, 4), all entries of the first three rows count as independent
            variables. "intrinsics" (C, 3, 3) is for fx, fy, cx and cy. Gradients of culled Gaussians are zero. In
            covars (N, 6), an off-diagonal entry has its whole gradient; in (N, 3, 3), each of its two places has half.

        Raises
        ------
        InputError
            If a shape is wrong, or compensations are given although `calc_compensations` was False.
        """
        values = {"means2d": means2d, "depths": depths, "conics": conics, "compensations": compensations}
        if compensations is not None and self.compensations is None:
            raise InputError("compensations: got a gradient, expected None, as calc_compensations was False")
        shape = self.depths.shape
        arrays = {
            name: array
            for name, width in _PROJECTED_ARRAY_WIDTHS.items()
            if (array := gradient(name, values[name], (*shape, width) if width else shape)) is not None
        }
        session, device = self._session, self._session.device
        count, viewmats, intrinsics = shape[1], [], []
        with session.lock:
            room = hosted_gradients(device, count, covariances=bool(self._covariances))
            for unseen in room.arrays.arrays if not self._views else ():
                unseen.fill(0.0)
            for index, view in enumerate(self._views):
                given = image_gradients(device, {name: array[index] for name, array in arrays.items()})
                by_camera = view.gradient(given, room.arrays, add=index > 0, by_camera=True)
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
    """Project Gaussians to the images of C cameras, with the conventions of gsplat's `fully_fused_projection`.

    Parameters
    ----------
    means : (N, 3) array_like
        World units.
    covars : (N, 6) or (N, 3, 3) array_like or None
        Covariances: upper triangles xx, xy, xz, yy, yz, zz, or matrices. None if quaternions and scales are given.
    quaternions : (N, 4) array_like or None
        w, x, y, z, of any length but 0. None if covars are given.
    scales : (N, 3) array_like or None
        Standard deviations in world units. None if covars are given.
    viewmats : (C, 4, 4) or (4, 4) array_like
        Camera from world.
    intrinsics : (C, 3, 3) or (3, 3) array_like
        Pixels. Skew is ignored.
    width, height : int
        Image size in pixels.
    eps2d : float
        Low-pass filter: variance in px^2, which is added to the diagonal of each projected covariance.
    near_plane, far_plane : float
        World units. Gaussians whose depth is not strictly between these are culled.
    radius_clip : float
        Pixels. Gaussians whose radii are at most this are culled.
    calc_compensations : bool
        Also compute sqrt(det(covariance without eps2d) / det(covariance with eps2d)).
    camera_model : str
        "pinhole", "ortho" or "fisheye" (equidistant).
    opacities : (N,) array_like, optional
        0 to 1. If given, the radii end where alpha is 1/255, and Gaussians with less opacity are culled.
    device : Device or str, optional
        An open device, or a name as `clsplat devices` lists them.

    Returns
    -------
    Projection
        The projected Gaussians, with their `vjp`.

    Raises
    ------
    InputError
        If a shape is wrong or numbers are not finite. The message names the argument.
    DeviceError
        If there is no such device.

    Notes
    -----
    Zwicker et al., EWA splatting, 2002; docs/gradients.md, section 22. float32 arrays may be read in place, and must
    not change before the last `vjp`.
    """
    given_means = floats("means", means, ("N", 3))
    count = len(given_means)
    planes = checked_planes(near_plane, far_plane, eps2d, radius_clip, camera_model)
    cameras = checked_cameras(viewmats, intrinsics, width, height, planes)
    shapes = GivenShapes.checked(count, covars, quaternions, scales)
    covers = None if opacities is None else floats("opacities", opacities, (count,))
    session = session_of(device)
    with session.lock:
        placed = from_host(session.device, given_means)
        inputs = shapes.inputs(placed, None if covers is None else from_host(session.device, covers))
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
            shapes.covariance_layout,
        )


def checked_cameras(
    viewmats: ArrayLike,
    intrinsics: ArrayLike,
    width: int | Sequence[int],
    height: int | Sequence[int],
    planes: CameraPlanes,
) -> list[EwaCamera]:
    """Return the cameras of viewmats (C, 4, 4) and intrinsics (C, 3, 3), or the camera of (4, 4) and (3, 3).

    width, height: in pixels; a number for all cameras, or one for each.
    planes: near and far plane, low-pass filter, culling radius and camera model, which all cameras share.
    Raises InputError, which names the argument.
    """
    poses = matrices("viewmats", viewmats, 4, "C")
    count = len(poses)
    lenses = matrices("intrinsics", intrinsics, 3, count)
    if len(lenses) != count:
        raise InputError(f"intrinsics has {len(lenses)} matrices, expected {count}, one for each matrix of viewmats")
    if not (lenses[:, [0, 1], [0, 1]] != 0).all():
        raise InputError("intrinsics: a focal length is 0, expected numbers other than 0")
    listed = zip(poses, lenses, sizes("width", width, count), sizes("height", height, count), strict=True)
    return [EwaCamera(pose, lens, across, down, *planes) for pose, lens, across, down in listed]


class CameraPlanes(NamedTuple):
    """Camera settings that all cameras of a call share.

    near, far: depths in world units between which Gaussians are drawn.
    eps2d: low-pass filter in px^2. radius_clip: radius in pixels up to which Gaussians are culled.
    model: one of EWA_CAMERA_MODELS.
    """

    near: float
    far: float
    eps2d: float
    radius_clip: float
    model: str


def checked_planes(
    near_plane: float, far_plane: float, eps2d: float, radius_clip: float, camera_model: str
) -> CameraPlanes:
    """Check the camera settings that all cameras share. Raises InputError, which names the argument."""
    choice("camera_model", camera_model, EWA_CAMERA_MODELS)
    near, far = number("near_plane", near_plane, -np.inf), number("far_plane", far_plane, -np.inf)
    if not near < far:
        raise InputError(f"near_plane is {near_plane} and far_plane is {far_plane}, expected near_plane < far_plane")
    most = float(np.finfo(np.float32).max)
    low_pass, clip = number("eps2d", eps2d, 0.0, most), number("radius_clip", radius_clip, 0.0, most)
    return CameraPlanes(near, far, low_pass, clip, camera_model)


def check_given(covars: object, quaternions: object, scales: object) -> None:
    """Raise InputError unless the caller gave either covars, or both quaternions and scales. None means not given."""
    if covars is None and (quaternions is None or scales is None):
        missing = "quaternions" if quaternions is None else "scales"
        raise InputError(f"{missing} is None, expected an array unless covars is given")
    if covars is not None and (quaternions is not None or scales is not None):
        raise InputError("covars: expected either covars, or quaternions and scales, not both")


@dataclass(frozen=True, eq=False)
class GivenShapes:
    """Checked quaternions (n, 4) and scales (n, 3) of Gaussians, or covariances (n, 6).

    covariance_layout: "upper" if the caller gave covariances (n, 6), "full" for (n, 3, 3), empty for none.
    """

    quaternions: Float32 | None = None
    scales: Float32 | None = None
    covariances: Float32 | None = None
    covariance_layout: str = ""

    @classmethod
    def checked(
        cls, count: int, covars: ArrayLike | None, quaternions: ArrayLike | None, scales: ArrayLike | None
    ) -> GivenShapes:
        """Check a caller's covariances, or quaternions and scales, and return them as float32 arrays.

        count: number of Gaussians, which the arrays must have.
        covars: None if quaternions and scales are given.
        Raises InputError, which names the argument.
        """
        check_given(covars, quaternions, scales)
        if quaternions is not None and scales is not None:
            turns = floats("quaternions", quaternions, (count, 4))
            return cls(turns, floats("scales", scales, (count, 3)))
        assert covars is not None, "check_given has refused calls without covars, quaternions and scales"
        given = floats("covars", covars, (count, 6), (count, 3, 3))
        if given.ndim == 2:
            return cls(covariances=given, covariance_layout="upper")
        flat = given.reshape(count, 9)
        upper = 0.5 * (flat[:, [0, 1, 2, 4, 5, 8]] + flat[:, [0, 3, 6, 4, 7, 8]])
        return cls(covariances=np.ascontiguousarray(upper, np.float32), covariance_layout="full")

    def inputs(self, means: DeviceArray, opacities: DeviceArray | None) -> EwaInputs:
        """Return the inputs of the projection, with all arrays on the device that holds `means`.

        means: (n, 3). opacities: (n,); if given, the bounding boxes of faint Gaussians are smaller.
        """
        quaternions, scales, covariances = (
            None if array is None else from_host(means.device, array)
            for array in (self.quaternions, self.scales, self.covariances)
        )
        return EwaInputs(means, quaternions, scales, covariances, opacities)


def full_gradient(upper: Float32) -> Float32:
    """Convert gradients of upper triangles (n, 6) to gradients (n, 3, 3) of all entries of symmetric matrices."""
    halves = upper * np.array([1, 0.5, 0.5, 1, 0.5, 1], np.float32)
    return np.asarray(halves[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3), np.float32)


def stacked(arrays: list[NDArray[Any]], each: NDArray[Any] | None = None) -> NDArray[Any]:
    """Stack the arrays of cameras on a new first axis. The array of a single camera is not copied.

    each: array with the shape and dtype of one camera's array. It gives those of the result if there are no cameras.
    """
    if len(arrays) == 1:
        return arrays[0][None]
    return np.stack(arrays) if arrays or each is None else np.zeros((0, *each.shape), each.dtype)
