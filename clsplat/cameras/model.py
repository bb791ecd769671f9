# SPDX-License-Identifier: Apache-2.0
"""CameraModel, the base class of projections (perspective, fisheye ...), and LensModel, a lens of photographs.

Equation numbers refer to docs/cameras.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple, Protocol

import numpy as np

from clsplat.arrays import Bool, Float64


class Intrinsics(Protocol):
    """The attributes of a `Camera` that a camera model reads."""

    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def fx(self) -> float: ...
    @property
    def fy(self) -> float: ...
    @property
    def cx(self) -> float: ...
    @property
    def cy(self) -> float: ...
    @property
    def near(self) -> float: ...
    @property
    def far(self) -> float: ...
    @property
    def radial(self) -> tuple[float, float, float, float]: ...
    @property
    def fold(self) -> tuple[float, float]: ...
    @property
    def frustum_limits(self) -> Float64: ...


class LensModel(NamedTuple):
    """A lens model of photographs.

    name: COLMAP's name, or clsplat's own if COLMAP does not have the lens.
    coefficients: number of distortion coefficients that `Camera.radial` takes.
    two_focal_model: for a model with one focal length, the name of its equivalent with fx and fy; "" for none.
    two_focal_coefficients: number of the equivalent's coefficients, which begin with this model's.
    is_colmap: False for a lens that only clsplat has. The parameters of such a lens are fx, fy, cx and cy, or
        width and height for a panorama.
    """

    name: str
    coefficients: int = 0
    two_focal_model: str = ""
    two_focal_coefficients: int = 0
    is_colmap: bool = True


class PlaneProjection(NamedTuple):
    """The linearised projection of points (N, 3) on an image plane.

    ratios: (N, 2), x/z and y/z as in the Jacobian, clamped.
    unclamped: (N, 2), True if the ratio is not clamped, and so has a gradient.
    jacobian: (N, 2, 3), derivative of the pixel coordinates with respect to the point.
    """

    ratios: Float64
    unclamped: Bool
    jacobian: Float64


@dataclass(frozen=True, eq=False)
class CameraModel:
    """A camera model: a row of `clsplat.camera.CAMERA_MODELS`. Its OpenCL functions are in kernels/shared/camera/.

    projection: the model's name in `Camera.projection` and in camera files.
    option: the field of `Camera` that selects this model among models of the same projection; "" for the default model.
    defines: build defines of the model's kernels. With RAYS a Gaussian is evaluated along the ray of each pixel.
    lenses: lens models of photographs that this model can be trained on, either as they are or undistorted.
    transforms: values of `camera_model` in a transforms.json that mean this model.
    nerfstudio: values of `camera_type` in nerfstudio's camera paths that mean this model.
    usd: values of a USD camera's `projection` that mean this model.
    opensfm: values of `projection_type` in OpenSfM's reconstruction.json that mean this model; "" for a missing one.
    metashape: types of Metashape's sensors that mean this model.
    realityscan: values of `DistortionModel` in RealityScan's XMP files that mean this model; "" for a missing one.
    gsplat: the model's name in gsplat, "" if gsplat lacks it.
    ewa: build define that selects the model in kernels/ewa.cl, gsplat's projection; "" if none is needed.
    """

    projection: str
    option: str = ""
    defines: Mapping[str, object] = field(default_factory=dict)
    lenses: tuple[LensModel, ...] = ()
    transforms: tuple[str, ...] = ()
    nerfstudio: tuple[str, ...] = ()
    usd: tuple[str, ...] = ()
    opensfm: tuple[str, ...] = ()
    metashape: tuple[str, ...] = ()
    realityscan: tuple[str, ...] = ()
    gsplat: str = ""
    ewa: str = ""

    flat: ClassVar[bool] = True
    """True if the model has an image plane. Near, far and the depths in files are then z, otherwise distances."""
    is_pinhole: ClassVar[bool] = False
    """True if pixel coordinates are linear in x/z and y/z, as in an undistorted photograph."""
    parallel: ClassVar[bool] = False
    """True if rays are parallel. Focal lengths are then in pixels per world unit, and there is no angle of view."""
    wraps: ClassVar[bool] = False
    """True for panoramas: the right edge continues at the left one, and nothing lies beyond the edges."""
    self_tested: ClassVar[bool] = True
    """True if the self-test renders a picture with this model. Used only for models that draw Gaussians along rays."""
    without_motion: ClassVar[str] = ""
    """For models without the channel `motion`: the end of the error message, which names this model and models that
    have the channel. Empty for models with the channel."""
    focal_keys: ClassVar[tuple[str, ...]] = ("fov_x", "fov_y")
    """Properties of a clsplat camera file that give a focal length, other than fx and fy."""
    whole_angles: ClassVar[tuple[float, float]] = (360.0, 180.0)
    """For panoramas: horizontal and vertical angle of view of a full panorama, in degrees."""

    @property
    def along_rays(self) -> bool:
        """True if a Gaussian is evaluated along the ray of each pixel; Gaussians are then sorted by distance.

        Otherwise Gaussians are ellipses on the image plane, sorted by z.
        """
        return "RAYS" in self.defines

    @property
    def named(self) -> str:
        """The projection with its article, such as "a fisheye", for messages."""
        return f"{'an' if self.projection[0] in 'aeiou' else 'a'} {self.projection}"

    def focal_length(self, fov: float, size: float) -> float:
        """Return the focal length in pixels with which `size` pixels show the angle of view `fov`, in radians: eq. (7).

        Raises ValueError for an angle that the model cannot show.
        """
        if not 0 < fov <= 2 * math.pi * (1 + 1e-12):
            raise ValueError(f"angle of view is {math.degrees(fov):g} degrees, expected more than 0 and at most 360")
        return size / fov

    def wide_focal(self, width: int) -> float:
        """Return a focal length in pixels for the self-test, short enough that `width` pixels show a wide angle."""
        return 0.25 * width

    def fold(self, radial: tuple[float, float, float, float]) -> tuple[float, float]:  # noqa: ARG002
        """Return the largest angle from the axis that the model shows, in radians, and the image radius at this angle.

        radial: coefficients k1 to k4 of a fisheye. The radius is in focal lengths.
        """
        return math.pi, math.pi

    def turn(self, view: Intrinsics) -> float:
        """Return the width in pixels of 360 degrees of a panorama; infinite for other models."""
        return 2 * math.pi * view.fx if self.wraps else math.inf

    def wrapped(self, view: Intrinsics, u: Float64) -> Float64:
        """Move columns u (N,), in pixels, by multiples of `turn` to within half a turn of the image's middle: eq. (6).

        In a panorama of 360 degrees, every u is then in [0, width), for any cx. Other models keep u.
        """
        if not self.wraps:
            return u
        turn = self.turn(view)
        low = 0.5 * (view.width - turn)
        moved: Float64 = low + np.mod(u - low, turn)
        return np.where(moved >= low + turn, low, moved)  # np.mod of a tiny negative number rounds up to `turn` itself

    def whole(self, width: int, height: int) -> tuple[float, float, float, float]:
        """Return fx, fy, cx and cy of a full panorama of `width` x `height` pixels. Only for panoramas."""
        raise NotImplementedError(self.projection)

    def is_whole(self, view: Intrinsics) -> bool:  # noqa: ARG002
        """Return True for a full panorama, which shows every direction once, with the camera's axis in the middle."""
        return False

    def ndc_from_cam(self, view: Intrinsics, width: int, height: int) -> Float64 | None:
        """Return the matrix (4, 4) from the camera's axes, with y up, to OpenEXR's NDC, for row vectors.

        None if the model has no image plane.

        width, height: size of the display window in pixels.
        """
        raise NotImplementedError(self.projection)

    def rays_of(self, view: Intrinsics, a: Float64, b: Float64) -> tuple[Float64, Float64]:
        """Return origins and unit directions (N, 3) of pixels' rays in the camera's axes; NaN for pixels without a ray.

        a, b: (N,), horizontal and vertical offsets of the pixels from the principal point, in focal lengths.
        """
        raise NotImplementedError(self.projection)

    def places_of(self, view: Intrinsics, points: Float64) -> tuple[Float64, Float64, Float64]:
        """Project points (N, 3) in the camera's axes. Points that the projection cannot show get NaN.

        Returns a and b (N,), horizontal and vertical offsets from the principal point in focal lengths, and depths
        (N,).
        """
        raise NotImplementedError(self.projection)

    def shows(self, view: Intrinsics, points: Float64) -> Bool:  # noqa: ARG002
        """Return a mask (N,) of the points (N, 3), in the camera's axes, whose direction a picture can show."""
        return np.ones(len(points), np.bool_)

    def pixel_widths(self, view: Intrinsics, points: Float64) -> Float64:
        """Return the width (N,) of a pixel, in world units, at points (N, 3) in the camera's axes.

        Infinite for points outside the frame. Eq. (88) of docs/gradients.md.
        """
        z, (low, high) = points[:, 2], view.frustum_limits
        with np.errstate(all="ignore"):
            ratios = points[:, :2] / points[:, 2:]
        seen = (z > view.near) & ((ratios > low) & (ratios < high)).all(axis=1)
        return np.where(seen, z / max(view.fx, view.fy), np.inf)

    # Methods for models that draw Gaussians on an image plane: those without the define RAYS.

    def divisors(self, z: Float64) -> Float64:
        """Return the numbers (N,) by which x and y are divided in the projection of points with depth z (N,)."""
        raise NotImplementedError(self.projection)

    def projected(self, view: Intrinsics, points: Float64) -> PlaneProjection:
        """Return the projection of points (N, 3), given in the camera's axes, with its derivatives."""
        raise NotImplementedError(self.projection)

    def mean_grad(
        self, view: Intrinsics, points: Float64, plane: PlaneProjection, d_jacobian: Float64, d_means2d: Float64
    ) -> Float64:
        """Return the gradient (N, 3) with respect to the points.

        plane: result of `projected` for these points.
        d_jacobian: (N, 2, 3), gradient with respect to the Jacobians.
        d_means2d: (N, 2), gradient with respect to the positions in the image, in pixels.
        """
        raise NotImplementedError(self.projection)

    # Methods for models with RAYS, which draw Gaussians on planes tangent to the sphere of directions.

    def footprints(self, view: Intrinsics, directions: Float64) -> tuple[Float64, Float64, Float64]:
        """Return the unit sphere's tangent planes at `directions` (N, 3), and a pixel's footprint on each.

        The first two results are the planes' axes to the right and down, each (N, 3). The third is the footprints
        (N, 2, 2), eqs. (9), (10): columns are the pixel's horizontal and vertical sides, in radians.
        """
        raise NotImplementedError(self.projection)

    def low_pass_grad(self, view: Intrinsics, directions: Float64, gradients: Float64, low_pass: float) -> Float64:
        """Return the gradient with respect to means' directions through the low-pass filter: B of eqs. (26) to (28).

        The result is (N, 2), with components along the axes of the tangent planes.

        directions: (N, 3), unit vectors from the camera to the means.
        gradients: (N, 2, 2), gradient with respect to the projected covariances.
        low_pass: variance in square pixels that is added to the projected covariance.
        """
        raise NotImplementedError(self.projection)
