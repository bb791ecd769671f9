# SPDX-License-Identifier: Apache-2.0
"""Launches ewa.cl and ewa_grad.cl: the EWA projection of Gaussians to the image plane, and its gradient.

The kernels follow gsplat's conventions. They can also compute the gradient with respect to the camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.camera import CAMERA_MODELS
from clsplat.device.buffers import DeviceArray, Workspace, from_host
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.errors import InputError
from clsplat.layouts.columns import EWA_CAMERA, EWA_GRADIENT
from clsplat.stages.device_camera import FARTHEST_PLANE
from clsplat.stages.sums import padded, row_sums

EWA_CAMERA_DEFINES = {model.gsplat: model.ewa for model in CAMERA_MODELS if model.gsplat}
"""Kernel define of each camera model, by gsplat's name of the model."""
EWA_CAMERA_MODELS = tuple(EWA_CAMERA_DEFINES)

EWA_CLAMP_FRACTION = 0.15
"""Margin around the image, as a fraction of its side, to which means are clamped in a pinhole camera's Jacobian."""

_TWO_FLOAT_FIELDS = tuple(name.removesuffix("_LOW") for name in EWA_CAMERA if name.endswith("_LOW"))


@dataclass(frozen=True, eq=False)
class EwaCamera:
    """A camera of the EWA projection.

    viewmat: (4, 4), camera from world. Its upper left 3x3 matrix need not be a rotation.
    intrinsics: (3, 3), with fx, fy, cx and cy in pixels; skew is ignored.
    width, height: pixels.
    near, far: world units; Gaussians whose depth is not strictly between these are culled.
    eps2d: px^2, added to the diagonal of the projected covariance.
    radius_clip: pixels; Gaussians with this radius or a smaller one are culled.
    model: one of EWA_CAMERA_MODELS.
    """

    viewmat: Float64
    intrinsics: Float64
    width: int
    height: int
    near: float = 0.01
    far: float = 1e10
    eps2d: float = 0.3
    radius_clip: float = 0.0
    model: str = "pinhole"

    @property
    def defines(self) -> dict[str, object]:
        """Kernel defines of the camera model. Raises InputError if it is not one of EWA_CAMERA_MODELS."""
        if self.model not in EWA_CAMERA_MODELS:
            raise InputError(f"camera model {self.model!r}: expected one of {', '.join(EWA_CAMERA_MODELS)}")
        return {EWA_CAMERA_DEFINES[self.model]: True} if EWA_CAMERA_DEFINES[self.model] else {}

    @property
    def position(self) -> Float64:
        """The camera's centre (3,) in the world. Raises InputError if the view matrix is singular."""
        try:
            inverse = np.linalg.inv(self.viewmat)
        except np.linalg.LinAlgError:
            raise InputError("viewmats: a matrix is singular, expected camera poses") from None
        return np.asarray(inverse[:3, 3], np.float64)

    def position_gradient(self, by_position: Float64) -> Float64:
        """The gradient (4, 4) with respect to the view matrix, from the gradient (3,) with respect to the camera's
        centre. All sixteen entries of the matrix count as independent variables."""
        inverse = np.linalg.inv(self.viewmat)
        by_inverse = np.zeros((4, 4))
        by_inverse[:3, 3] = by_position
        return np.asarray(-inverse.T @ by_inverse @ inverse.T, np.float64)

    def packed(self) -> Float32:
        """The camera's fields as float32 in the order of `columns.EWA_CAMERA`."""
        rotation, shift = self.viewmat[:3, :3], self.viewmat[:3, 3]
        fx, fy, cx, cy = (self.intrinsics[at] for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
        cofactors = np.stack([np.cross(rotation[(i + 1) % 3], rotation[(i + 2) % 3]) for i in range(3)])
        values = {
            **dict(zip(("FX", "FY", "CX", "CY"), (fx, fy, cx, cy), strict=True)),
            "XMIN": -(cx + EWA_CLAMP_FRACTION * self.width) / fx,
            "XMAX": ((1 + EWA_CLAMP_FRACTION) * self.width - cx) / fx,
            "YMIN": -(cy + EWA_CLAMP_FRACTION * self.height) / fy,
            "YMAX": ((1 + EWA_CLAMP_FRACTION) * self.height - cy) / fy,
            "NEAR": self.near,
            "FAR": min(self.far, FARTHEST_PLANE),
            "WIDTH": self.width,
            "HEIGHT": self.height,
            "EPS": self.eps2d,
            "RADIUS_CLIP": self.radius_clip,
        }
        for row in range(3):
            values[f"T{row}"] = shift[row]
            for column in range(3):
                values[f"R{row}{column}"] = rotation[row, column]
                values[f"N{row}{column}"] = cofactors[row, column]
        exact = {name: float(value) for name, value in values.items()}
        low = {f"{name}_LOW": exact[name] - float(np.float32(exact[name])) for name in _TWO_FLOAT_FIELDS}
        return np.array([{**exact, **low}[name] for name in EWA_CAMERA], np.float32)


@dataclass(frozen=True, eq=False)
class PlacedEwaCamera:
    """A camera, with its fields on the device in the order of `columns.EWA_CAMERA`."""

    camera: EwaCamera
    fields: DeviceArray

    @classmethod
    def on(cls, device: Device, camera: EwaCamera) -> PlacedEwaCamera:
        """Upload a camera's fields to this device."""
        return cls(camera, from_host(device, camera.packed()))


@dataclass(frozen=True, eq=False)
class EwaInputs:
    """Input of the EWA projection: n Gaussians, all arrays float32.

    means: (n, 3), world units.
    quaternions: (n, 4), w x y z, of any nonzero length.
    scales: (n, 3), world units.
    covariances: (n, 6), instead of quaternions and scales: upper triangles xx, xy, xz, yy, yz, zz.
    opacities: (n,), 0 to 1, optional; with them, the radii of faint Gaussians are smaller.
    """

    means: DeviceArray
    quaternions: DeviceArray | None = None
    scales: DeviceArray | None = None
    covariances: DeviceArray | None = None
    opacities: DeviceArray | None = None

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return self.means.shape[0]

    @property
    def shapes(self) -> tuple[DeviceArray, ...]:
        """Quaternions and scales, or the covariances. Raises InputError if neither is given, or both."""
        given = (self.quaternions, self.scales)
        if self.covariances is not None and given == (None, None):
            return (self.covariances,)
        if self.covariances is None and self.quaternions is not None and self.scales is not None:
            return (self.quaternions, self.scales)
        raise InputError("Gaussians: expected either quaternions and scales, or covariances")


@dataclass(frozen=True, eq=False)
class Ewa:
    """Projected Gaussians. Rows of culled Gaussians are zero.

    radii: (n, 2) int32, whole pixels, 0 where culled.
    means2d: (n, 2), pixels.
    depths: (n,), world units.
    conics: (n, 3), a, b, c in 1 / px^2.
    compensations: (n,), 0 to 1, if requested.
    """

    radii: DeviceArray
    means2d: DeviceArray
    depths: DeviceArray
    conics: DeviceArray
    compensations: DeviceArray | None = None


@dataclass(frozen=True, eq=False)
class EwaImageGradients:
    """Gradients with respect to the arrays of `Ewa`, with the same shapes. None means zero.

    The entry b of a conic fills two places of a symmetric matrix, but counts as one variable.
    """

    means2d: DeviceArray | None = None
    depths: DeviceArray | None = None
    conics: DeviceArray | None = None
    compensations: DeviceArray | None = None


@dataclass(frozen=True, eq=False)
class EwaGradients:
    """Gradients with respect to the arrays of EwaInputs, with the same shapes.

    The gradient with respect to an off-diagonal entry of a covariance is the sum over both places in the matrix.
    """

    means: DeviceArray
    quaternions: DeviceArray | None = None
    scales: DeviceArray | None = None
    covariances: DeviceArray | None = None

    @property
    def arrays(self) -> tuple[DeviceArray, ...]:
        """The gradient arrays that are not None."""
        every = (self.means, self.covariances, self.quaternions, self.scales)
        return tuple(array for array in every if array is not None)


@stage("ewa")
def ewa(device: Device, gaussians: EwaInputs, camera: PlacedEwaCamera, projected: Ewa) -> None:
    """Project all Gaussians to a camera's image, into `projected`. Equations (150) to (158) of docs/gradients.md.

    If opacities are given and compensations requested, the radii are computed from opacity times compensation.
    """
    n = gaussians.count
    defines = _defines(gaussians, camera.camera, compensated=projected.compensations is not None)
    defines |= {} if gaussians.opacities is None else {"OPACITIES": True}
    launch_items(
        device,
        device.kernels("ewa", defines).ewa,
        -(-n // device.shape.lanes),
        n,
        camera.fields,
        gaussians.means,
        *gaussians.shapes,
        *([] if gaussians.opacities is None else [gaussians.opacities]),
        *(projected.radii, projected.means2d, projected.depths, projected.conics),
        *([] if projected.compensations is None else [projected.compensations]),
    )


@stage("ewa_grad")
def ewa_grad(
    device: Device,
    work: Workspace,
    gaussians: EwaInputs,
    camera: PlacedEwaCamera,
    projected: Ewa,
    given: EwaImageGradients,
    gradients: EwaGradients,
    *,
    add: bool = False,
    by_camera: bool = False,
) -> DeviceArray | None:
    """Fill `gradients` from the gradients `given` with respect to the projected arrays. Equations (159) to (166).

    add: add to existing gradients, such as those of earlier cameras.
    by_camera: return the gradient (16,) with respect to the camera, in the order of `columns.EWA_GRADIENT`;
    `camera_gradients` turns it into matrices.

    Culled Gaussians have no gradient.
    """
    n = gaussians.count
    defines = _defines(gaussians, camera.camera, compensated=given.compensations is not None)
    defines |= {"ADDED": True} if add else {}
    parts = work.array("ewa_by_camera", (len(EWA_GRADIENT), padded(n))) if by_camera else None
    defines |= {} if parts is None else {"BY_CAMERA": True}
    launch_items(
        device,
        device.kernels("ewa_grad", defines).ewa_grad,
        -(-padded(n) // device.shape.lanes),
        n,
        padded(n),
        camera.fields,
        gaussians.means,
        *gaussians.shapes,
        projected.radii,
        given.means2d or _zeros(work, "means2d", (n, 2)),
        given.depths or _zeros(work, "depths", (n,)),
        given.conics or _zeros(work, "conics", (n, 3)),
        *([] if given.compensations is None else [given.compensations]),
        *gradients.arrays,
        *([] if parts is None else [parts]),
    )
    return None if parts is None else row_sums(device, work, "ewa", parts)


def camera_gradients(by_camera: NDArray[np.floating]) -> tuple[Float64, Float64]:
    """Split the gradient (16,) of `ewa_grad` into those of the view matrix (4, 4) and of the intrinsics (3, 3).

    The gradient of the view matrix's last row is zero.
    """
    values = dict(zip(EWA_GRADIENT, np.asarray(by_camera, np.float64), strict=True))
    viewmat, intrinsics = np.zeros((4, 4)), np.zeros((3, 3))
    for row in range(3):
        viewmat[row] = [*(values[f"R{row}{column}"] for column in range(3)), values[f"T{row}"]]
    for name, at in {"FX": (0, 0), "FY": (1, 1), "CX": (0, 2), "CY": (1, 2)}.items():
        intrinsics[at] = values[name]
    return viewmat, intrinsics


def _defines(gaussians: EwaInputs, camera: EwaCamera, *, compensated: bool) -> dict[str, object]:
    wanted = {"COVARIANCES": gaussians.covariances is not None, "COMPENSATED": compensated}
    return {**camera.defines, **{name: True for name, on in wanted.items() if on}}


def _zeros(work: Workspace, name: str, shape: tuple[int, ...]) -> DeviceArray:
    array = work.array(f"ewa_no_{name}", shape)
    array.fill(0.0)
    return array
