# SPDX-License-Identifier: Apache-2.0
"""Lenses of survey programs: Brown's distortion and polynomial fisheyes, as COLMAP's camera models."""

from __future__ import annotations

from dataclasses import dataclass

from clsplat.camera import model_with, names_of
from clsplat.cameras.model import CameraModel
from clsplat.errors import InputError
from clsplat.scenes.camera_json import short
from clsplat.scenes.dataset import Lens, check_lens

UNDISTORTED_ADVICE = "export undistorted photographs and their cameras instead"


@dataclass(frozen=True)
class SurveyLens:
    """A lens with Brown's distortion, or a fisheye with the same polynomials of the angle from the axis.

    width, height: size of the photographs in pixels.
    focal: fx, fy in pixels.
    centre: principal point in pixels; the centre of the first pixel is at (0.5, 0.5).
    radial: k1 to k4, the coefficients of r^2, r^4, r^6, r^8.
    tangential: p1, p2 in OpenCV's order: x moves by 2 p1 x y + p2 (r^2 + 2 x^2).
    is_fisheye: True for an equidistant fisheye, where r is the angle from the axis in radians.
    """

    width: int
    height: int
    focal: tuple[float, float]
    centre: tuple[float, float]
    radial: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)
    is_fisheye: bool = False

    def lens(self, where: str) -> Lens:
        """Return the lens as a COLMAP model without loss.

        where: beginning of the error message.
        Raises InputError for invalid values, and for a distortion that no COLMAP model has.
        """
        k1, k2, k3, k4 = self.radial
        p1, p2 = self.tangential
        distortion: tuple[float, ...]
        if self.is_fisheye:
            if p1 or p2:
                model, distortion = "THIN_PRISM_FISHEYE", (k1, k2, p1, p2, k3, k4, 0.0, 0.0)
            else:
                model, distortion = "OPENCV_FISHEYE", self.radial
        elif k4:
            raise InputError(
                f"{where}: its distortion has k4 = {k4:g} (the coefficient of r^8), expected 0, as no lens model here "
                f"has this term; {UNDISTORTED_ADVICE}, or calibrate without k4"
            )
        elif k3:
            model, distortion = "FULL_OPENCV", (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
        elif k1 or k2 or p1 or p2:
            model, distortion = "OPENCV", (k1, k2, p1, p2)
        else:
            model, distortion = "PINHOLE", ()
        return check_lens(Lens(model, self.width, self.height, (*self.focal, *self.centre, *distortion)), where)


def panorama(model: CameraModel, width: int, height: int, where: str) -> Lens:
    """Return the lens of a full panorama. Raises InputError for an invalid size.

    model: a camera model of panoramas.
    where: beginning of the error message.
    """
    return check_lens(Lens(model.lenses[0].name, width, height, (float(width), float(height))), where)


def model_of_kind(program: str, kind: str, where: str, key: str = "") -> CameraModel:
    """Return the camera model of a kind of lens in a survey program's file. Raises InputError for an unsupported kind.

    program: attribute of CameraModel with the program's names.
    where: beginning of the error message. key: text before the kind in the message.
    """
    model = model_with(program, kind)
    if model is None:
        known = ", ".join(filter(None, names_of(program)))
        raise InputError(f"{where}: the lens is {key}{short(kind)}, expected {known}; {UNDISTORTED_ADVICE}")
    return model
