# SPDX-License-Identifier: Apache-2.0
"""New coordinate frame of a scene by `--orient` and `--scale`: the similarity of the change, and its record."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.config.orientation import FrameUse, ScaleRule, parse_scale
from clsplat.errors import InputError, warn
from clsplat.images.geotags import GpsPosition, gps_of, gravity_of
from clsplat.models.edit import decompose, moved, scaling
from clsplat.scenes.dataset import DataSet, PosedImage, SceneFrame
from clsplat.scenes.orientation.known_length import metres_per_unit
from clsplat.scenes.orientation.level import COLMAP_UP
from clsplat.scenes.orientation.positions import MapFit, fit_map, globe_position, up_from_gps
from clsplat.scenes.orientation.upright import MIN_UPRIGHT_CAMERAS, Upright, up_from_gravity, upright
from clsplat.scenes.outliers import stray_cameras

SAME_SCALE_TOLERANCE = 1e-9
"""Relative difference of two scales, or of places, that counts as rounding, so that the same --scale again changes
nothing."""


@dataclass(frozen=True, eq=False)
class _Subject:
    """The scene whose frame changes.

    where: name of the scene for messages.
    cameras: by the images' names, in the order of the names, without outliers.
    points: (N, 3), in the scene's present frame.
    files: the photographs whose metadata are read, by the images' names.
    turned: as for `new_frame`.
    """

    where: object
    cameras: Mapping[str, Camera]
    points: Float64
    files: Mapping[str, Path]
    turned: bool

    @cached_property
    def positions(self) -> dict[str, GpsPosition]:
        """GPS positions, by the images' names."""
        found = {name: gps_of(self.files[name]) for name in self.cameras if name in self.files}
        return {name: at for name, at in found.items() if at is not None}

    def upright(self) -> Upright:
        """Find the scene's up direction, ground and middle. Raises InputError if there are too few cameras."""
        known = {name: gravity_of(self.files[name], upright=self.turned) for name in self.cameras if name in self.files}
        gravity = {name: down for name, down in known.items() if down is not None}
        measured = up_from_gravity(self.cameras, gravity) or up_from_gps(self.cameras, self.positions)
        try:
            return upright(list(self.cameras.values()), self.points, measured)
        except InputError as error:
            raise InputError(f"{self.where}: {error}; use --orient none to keep its axes") from None

    def fit_map(self, up: Float64) -> MapFit:
        """Fit the cameras to the GPS positions on the map. Warns of wrong positions. Raises InputError.

        up: (3,), unit vector in the world.
        """
        try:
            fit = fit_map(self.cameras, self.positions, up)
        except InputError as error:
            raise InputError(f"{self.where}: --scale gps: {error}") from None
        if fit.doubt:
            warn(f"{self.where}: {fit.doubt}")
        return fit

    def metres_per_unit(self, scale: str, rule: ScaleRule) -> float:
        """Return the length of a world unit in metres, from a known length. Raises InputError.

        scale: value of --scale, for messages. rule: the parsed value.
        """
        try:
            return metres_per_unit(rule, self.cameras)
        except InputError as error:
            raise InputError(f"{self.where}: --scale {scale}: {error}") from None


def new_frame(
    where: object, data: DataSet, files: Mapping[str, Path], use: FrameUse, frame: SceneFrame, *, turned: bool
) -> SceneFrame:
    """Return the coordinate frame that a scene has after a change.

    where: the scene, for messages.
    data: the scene's cameras and points, in its present frame.
    files: the photographs whose metadata are read, by the images' names.
    use: the change.
    frame: the present frame.
    turned: True if the cameras fit the photographs after their EXIF orientation, False if they fit the stored pixels.
    Warns of wrong GPS positions. Raises InputError if the change cannot be made.
    """
    by_gps = use.scale == "gps"
    if (use.orient == "up" and frame.upright and not by_gps) or (use.orient == "none" and not frame.upright):
        use = replace(use, orient=None)  # the frame has these axes already
    if not use:
        return frame
    subject = _Subject(where, _cameras(data), data.points, files, turned)
    change, known = np.eye(4), frame
    if use.orient == "none":
        scale, *_ = decompose(frame.world_from_source)
        change = scaling(scale) @ np.linalg.inv(frame.world_from_source)
        known = replace(known, upright=False, origin=(), up_note="")
    elif use.orient == "up":
        found = subject.upright()
        fit = subject.fit_map(found.up) if by_gps else None
        change = found.motion(None if fit is None else fit.north)
        known = replace(known, upright=True, origin=(), up_note=found.note)
    if (rule := parse_scale(use.scale)) is not None:
        if rule.kind != "gps":
            unit, note = subject.metres_per_unit(use.scale, rule), f"the known length {use.scale}"
            factor, known = _to_metres(unit, rule, known)
        else:
            up = found.up if use.orient == "up" else np.array(COLMAP_UP) if frame.upright else subject.upright().up
            fit = subject.fit_map(up) if use.orient != "up" or fit is None else fit
            factor = unit = fit.metres
            note = fit.note
            if use.orient == "up":
                places = {name: factor * moved(one.position, change) for name, one in subject.cameras.items()}
                known = replace(known, origin=globe_position(fit, subject.positions, places))
        change = scaling(factor) @ change
        marks = [(one.upright, one.metres, bool(one.origin)) for one in (frame, replace(known, metres=True))]
        if by_gps and marks[0] == marks[1] and _is_rounding(change, subject.cameras.values()):
            return frame  # which has the note of the first fit
        if not (frame.metres and factor == 1):
            known = replace(known, metres=True, scale_note=f"metres are from {note}: a unit was {unit:.6g} m")
    matrix = change @ frame.world_from_source
    if use.orient == "none":  # without rounding errors, so that the axes are exactly the source's
        matrix = scaling(round(decompose(matrix)[0], 12))
    return replace(known, world_from_source=matrix)


def _is_rounding(change: Float64, cameras: Iterable[Camera]) -> bool:
    """Return True if a similarity (4, 4) moves no camera but by rounding, as the same fit to GPS positions again."""
    places = np.stack([camera.position for camera in cameras])
    return bool(np.abs(moved(places, change) - places).max() <= SAME_SCALE_TOLERANCE * np.abs(places).max())


def _to_metres(unit: float, rule: ScaleRule, frame: SceneFrame) -> tuple[float, SceneFrame]:
    """Return the factor that brings a frame's units to metres, and the frame with the two points of the rule.

    The same two points given again were measured before the scene was scaled, so `unit` is for the scale at that time.

    unit: length in metres of the unit in which the rule's points or cameras were measured.
    """
    now = decompose(frame.world_from_source)[0]
    either_way = (rule.ends, rule.ends[3:] + rule.ends[:3])
    then = frame.measured[6] if rule.kind == "points" and frame.measured[:6] in either_way else now
    factor = unit * then / now
    if rule.kind == "points":
        frame = replace(frame, measured=(*rule.ends, then))
    return (1.0 if abs(factor - 1) < SAME_SCALE_TOLERANCE else factor), frame


def _cameras(data: DataSet) -> dict[str, Camera]:
    """Return the cameras by the images' names, in the order of the names, without outliers."""
    images = sorted(data.images, key=lambda image: image.name)
    cameras = {image.name: image.lens.camera(image.rotation, image.translation, "undistort") for image in images}
    far = stray_cameras(list(cameras.values()))
    if len(cameras) - far.sum() < MIN_UPRIGHT_CAMERAS:
        return cameras
    return {name: camera for (name, camera), stray in zip(cameras.items(), far, strict=True) if not stray}


def in_frame(data: DataSet, change: Float64) -> DataSet:
    """Return a data set with its cameras and points moved by a similarity (4, 4)."""
    scale, turn, shift = decompose(change)
    images: list[PosedImage] = []
    for image in data.images:
        rotation = image.rotation @ turn.T
        images.append(replace(image, rotation=rotation, translation=scale * image.translation - rotation @ shift))
    box = None  # its sides would not be parallel to the axes of a turned world
    place = None if data.georeference is None else data.georeference.moved(change)
    return replace(data, images=images, points=moved(data.points, change), box=box, georeference=place)
