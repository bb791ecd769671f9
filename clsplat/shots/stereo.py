# SPDX-License-Identifier: Apache-2.0
"""Stereo pairs: the two eyes' cameras, offset from a shot's own cameras or read from a USD stage."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.camera import Camera
from clsplat.config.stereo import EYES, Eye
from clsplat.errors import InputError, examples
from clsplat.models.formats.usd import open_stage, readable, survive
from clsplat.shots.shot import Shot

EYE_FIELD_PATTERN = re.compile(r"\{eye\}|%V|%v")
"""A field for an eye's name in a file name: {eye} or %V for the name, %v for its first letter, as in Nuke."""


def for_eye(pattern: str, eye: str) -> str:
    """Replace the field for an eye in a file pattern by the eye's name. If `eye` is empty, nothing is replaced."""
    return EYE_FIELD_PATTERN.sub(lambda match: eye[:1] if match[0] == "%v" else eye, pattern) if eye else pattern


def seen_by(camera: Camera, eye: Eye, distance: float, convergence: float = math.inf) -> Camera:
    """The camera of one eye. The eyes are `distance` world units apart, one on each side of `camera`.

    camera: of a whole frame, not of a strip or window.
    Both eyes look in the camera's direction. The principal point is shifted so that points at the depth `convergence`
    fall on the same pixel in both. Raises InputError if the camera is not perspective.
    """
    if not camera.is_pinhole:
        raise InputError(f"--stereo: a frame is {camera.projection}, expected perspective cameras")
    aside = (-0.5 if eye == "left" else 0.5) * distance
    moved = camera.translation - np.array([aside, 0.0, 0.0])
    return replace(camera, translation=moved, cx=camera.cx + camera.fx * aside / convergence)


def shot_of(shot: Shot, eye: Eye, distance: float, convergence: float = math.inf) -> Shot:
    """Replace the cameras of a shot by the cameras of one eye, from `seen_by`. Raises InputError."""

    def seen(camera: Camera) -> Camera:
        return seen_by(camera, eye, distance, convergence)

    frames = tuple(replace(frame, camera=seen(frame.camera)) for frame in shot.frames)
    moment = shot.moment
    return replace(shot, frames=frames, moment=None if moment is None else lambda time: seen(moment(time)))


def pair_of_stage(path: Path, prim: str | None = None) -> tuple[str, str]:
    """Paths of a USD stage's left and right camera (stereoRole), which are children of the same prim.

    prim: path or name of that prim or of one of the cameras, to choose one of several pairs.
    Raises InputError if there is no such pair or more than one, and like `usd.read_usd`.
    """
    survive(path, "clsplat.shots.stereo:pair_here", prim=prim)
    return pair_here(path, prim)


def pair_here(path: Path, prim: str | None = None) -> tuple[str, str]:
    """Find the cameras like `pair_of_stage`, in a file that is known not to crash USD's library."""
    from pxr import UsdGeom, UsdUtils

    delegate = UsdUtils.CoalescingDiagnosticDelegate()  # captures the messages that USD would print
    stage = open_stage(path, path)
    rigs: dict[str, dict[str, list[Any]]] = {}
    with readable(path):
        for item in stage.Traverse():
            if item.IsA(UsdGeom.Camera) and (role := str(UsdGeom.Camera(item).GetStereoRoleAttr().Get())) in EYES:
                rigs.setdefault(str(item.GetParent().GetPath()), {}).setdefault(role, []).append(item)
    delegate.TakeUncoalescedDiagnostics()
    pairs = {
        rig: (roles["left"][0], roles["right"][0])
        for rig, roles in rigs.items()
        if all(len(roles.get(eye, ())) == 1 for eye in EYES)
    }
    asked = {
        rig: pair
        for rig, pair in pairs.items()
        if prim is None
        or prim in (rig, rig.rpartition("/")[2])
        or any(prim in (str(camera.GetPath()), camera.GetName()) for camera in pair)
    }
    if len(asked) != 1:
        if not pairs:
            raise InputError(
                f"{path}: --stereo stage: no prim has one camera of stereoRole left and one of right among its "
                "children, expected such a pair; or give --stereo DISTANCE"
            )
        flag = "" if prim is None else f"--usd-camera {prim}: "
        problem = "belongs to no pair" if prim is not None and not asked else f"has {len(asked)} pairs"
        raise InputError(f"{path}: {flag}{problem}, expected --usd-camera with one of {examples(sorted(pairs))}")
    left, right = next(iter(asked.values()))
    return str(left.GetPath()), str(right.GetPath())
