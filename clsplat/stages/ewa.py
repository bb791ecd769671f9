# SPDX-License-Identifier: Apache-2.0
"""Launches ewa.cl and ewa_grad.cl: Gaussians to means, conics, depths and radii on the image, with gsplat's
conventions, and the gradient back, by the camera too."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.device.buffers import DeviceArray, Workspace, from_host
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.layout import EWA_CAMERA, EWA_GRADIENT
from clsplat.device.profile import stage
from clsplat.errors import InputError
from clsplat.stages.sums import padded, row_sums

MODELS = {"pinhole": "", "ortho": "ORTHOGRAPHIC", "fisheye": "FISHEYE"}
"""Camera models by gsplat's names, and the defines that they have."""

SLACK = 0.15
"""Of the image's side: how far beyond an edge the place of a mean may be in the Jacobian of a pinhole camera."""

_ROUNDED = tuple(name.removesuffix("_LOW") for name in EWA_CAMERA if name.endswith("_LOW"))
_FARTHEST = float(np.finfo(np.float32).max)


@dataclass(frozen=True, eq=False)
class EwaCamera:
    """A camera. viewmat (4, 4): camera from world, any numbers in its first three rows; intrinsics (3, 3): fx, fy, cx
    and cy in pixels, a skew is not looked at; width, height: pixels; near, far: world units; eps2d: px^2, added to the
    diagonal of the projected covariance; radius_clip: pixels, what has no larger radius is left out; model: one of
    MODELS."""

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
        """Defines of the kernels. Raises InputError for a model that is none of MODELS."""
        if self.model not in MODELS:
            raise InputError(f"camera model {self.model!r}: expected one of {', '.join(MODELS)}")
        return {MODELS[self.model]: True} if MODELS[self.model] else {}

    @property
    def position(self) -> Float64:
        """The camera's centre (3,) in the world. Raises InputError where the view matrix has no inverse."""
        try:
            inverse = np.linalg.inv(self.viewmat)
        except np.linalg.LinAlgError:
            raise InputError("viewmats: a matrix has no inverse, expected the pose of a camera") from None
        return np.asarray(inverse[:3, 3], np.float64)

    def position_gradient(self, by_position: Float64) -> Float64:
        """The gradient (4, 4) by the view matrix from that (3,) by the centre, all sixteen numbers taken as free."""
        inverse = np.linalg.inv(self.viewmat)
        by_inverse = np.zeros((4, 4))
        by_inverse[:3, 3] = by_position
        return np.asarray(-inverse.T @ by_inverse @ inverse.T, np.float64)

    def packed(self) -> Float32:
        """The camera in the order of `layout.EWA_CAMERA`."""
        rotation, shift = self.viewmat[:3, :3], self.viewmat[:3, 3]
        fx, fy, cx, cy = (self.intrinsics[at] for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
        cofactors = np.stack([np.cross(rotation[(i + 1) % 3], rotation[(i + 2) % 3]) for i in range(3)])
        values = {
            **dict(zip(("FX", "FY", "CX", "CY"), (fx, fy, cx, cy), strict=True)),
            "XMIN": -(cx + SLACK * self.width) / fx,
            "XMAX": ((1 + SLACK) * self.width - cx) / fx,
            "YMIN": -(cy + SLACK * self.height) / fy,
            "YMAX": ((1 + SLACK) * self.height - cy) / fy,
            "NEAR": self.near,
            "FAR": min(self.far, _FARTHEST),
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
        low = {f"{name}_LOW": exact[name] - float(np.float32(exact[name])) for name in _ROUNDED}
        return np.array([{**exact, **low}[name] for name in EWA_CAMERA], np.float32)


@dataclass(frozen=True, eq=False)
class EwaInputs:
    """n Gaussians. means (n, 3): world units; quaternions (n, 4), w x y z, of any length but 0, and scales (n, 3) in
    world units, or in their place covariances (n, 6), upper triangles xx, xy, xz, yy, yz, zz; opacities (n,), 0 to 1,
    where they are to make the boxes smaller. All float32."""

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
        """Quaternions and scales, or the covariances. Raises InputError where neither is given, or both."""
        given = (self.quaternions, self.scales)
        if self.covariances is not None and given == (None, None):
            return (self.covariances,)
        if self.covariances is None and self.quaternions is not None and self.scales is not None:
            return (self.quaternions, self.scales)
        raise InputError("Gaussians: expected either quaternions and scales, or covariances")


@dataclass(frozen=True, eq=False)
class Ewa:
    """Gaussians on the image: radii (n, 2) int32, whole pixels, 0 where culled; means2d (n, 2): pixels; depths (n,):
    world units; conics (n, 3): a, b, c in 1 / px^2; compensations (n,), 0 to 1, where asked for. Rows of what is culled
    are zero."""

    radii: DeviceArray
    means2d: DeviceArray
    depths: DeviceArray
    conics: DeviceArray
    compensations: DeviceArray | None = None


@dataclass(frozen=True, eq=False)
class EwaGradients:
    """Gradients by what EwaInputs has, and of its shapes; by an off-diagonal number of a covariance for both its
    places."""

    means: DeviceArray
    quaternions: DeviceArray | None = None
    scales: DeviceArray | None = None
    covariances: DeviceArray | None = None

    @property
    def arrays(self) -> tuple[DeviceArray, ...]:
        """Those that there are."""
        every = (self.means, self.covariances, self.quaternions, self.scales)
        return tuple(array for array in every if array is not None)


def ewa_array(device: Device, camera: EwaCamera) -> DeviceArray:
    """The camera on the device."""
    return from_host(device, camera.packed())


@stage("ewa")
def ewa(device: Device, gaussians: EwaInputs, camera: EwaCamera, camera_array: DeviceArray, projected: Ewa) -> None:
    """Project all Gaussians to a camera's image: fill `projected`.

    camera_array: `ewa_array` of the camera. Where compensations are asked for they count in the boxes of what has
    opacities. Equations (150) to (158) of docs/gradients.md.
    """
    n = gaussians.count
    defines = _defines(gaussians, camera, compensated=projected.compensations is not None)
    defines |= {} if gaussians.opacities is None else {"OPACITIES": True}
    launch_items(
        device,
        device.kernels("ewa", **defines).ewa,
        -(-n // device.shape.lanes),
        n,
        camera_array,
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
    camera: EwaCamera,
    camera_array: DeviceArray,
    projected: Ewa,
    gradients: EwaGradients,
    *,
    means2d: DeviceArray | None = None,
    depths: DeviceArray | None = None,
    conics: DeviceArray | None = None,
    compensations: DeviceArray | None = None,
    add: bool = False,
    by_camera: bool = False,
) -> DeviceArray | None:
    """Fill `gradients` from those by means2d (n, 2), depths (n,), conics (n, 3), of b as one number, and compensations
    (n,), of which any may be missing; add: to what is there, as of the cameras before this.

    by_camera: the result is the gradient by the camera (16,), in the order of `layout.EWA_GRADIENT`, which
    `camera_gradients` makes matrices of. What is culled has no gradient. Equations (159) to (166).
    """
    n = gaussians.count
    defines = _defines(gaussians, camera, compensated=compensations is not None)
    defines |= {"ADDED": True} if add else {}
    parts = work.array("ewa_by_camera", (len(EWA_GRADIENT), padded(n))) if by_camera else None
    defines |= {} if parts is None else {"BY_CAMERA": True}
    launch_items(
        device,
        device.kernels("ewa_grad", **defines).ewa_grad,
        -(-padded(n) // device.shape.lanes),
        n,
        padded(n),
        camera_array,
        gaussians.means,
        *gaussians.shapes,
        projected.radii,
        means2d or _zeros(work, "means2d", (n, 2)),
        depths or _zeros(work, "depths", (n,)),
        conics or _zeros(work, "conics", (n, 3)),
        *([] if compensations is None else [compensations]),
        *gradients.arrays,
        *([] if parts is None else [parts]),
    )
    return None if parts is None else row_sums(device, work, "ewa", parts)


def camera_gradients(by_camera: NDArray[np.floating]) -> tuple[Float64, Float64]:
    """Gradients by the view matrix (4, 4), of which the last row has none, and by the intrinsics (3, 3), from those
    (16,) of `ewa_grad`."""
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
