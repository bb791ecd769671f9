# SPDX-License-Identifier: Apache-2.0
"""Refined cameras at the end of a training: written as a COLMAP model, with warnings about large changes."""

from __future__ import annotations

import warnings
from collections.abc import Mapping

from clsplat.errors import examples
from clsplat.files.atomic import atomic_write
from clsplat.runs.run import Run
from clsplat.scenes.geography.georeference import GEOREFERENCE_FILE
from clsplat.scenes.readers.colmap_writer import write_model
from clsplat.scenes.scene import Scene
from clsplat.training.cameras.intrinsics import RefinedLenses
from clsplat.training.cameras.poses import Poses
from clsplat.training.cameras.validation_gate import Drift

POSE_WARNING_DEGREES, POSE_WARNING_UNITS = 5.0, 0.1
"""Rotation in degrees, and movement relative to the length unit, above which a refined pose causes a warning."""
LENS_WARNING_FOCAL_LENGTHS = 0.1
"""Change of a focal length or principal point, as a fraction of the focal length, above which there is a warning."""


def keep_cameras(run: Run, scene: Scene, poses: Poses, lenses: RefinedLenses, along: Drift | None) -> None:
    """Write the refined cameras as a COLMAP model into the run's folder, and warn of any camera with a large change.

    along: drift of the refined poses, by which held-out poses and points are moved too; None without refined poses.
    """
    cameras, points = {view.name: view.camera for view in scene.views}, scene.points
    if along is not None:
        cameras = {name: along.taken_along(camera) for name, camera in cameras.items()}
        points = along.points(points)
    cameras |= {view.name: camera for view, camera in zip(scene.train_views, poses.cameras, strict=True)}
    images = [(view.name, lenses.refined(view.lens), cameras[view.name]) for view in scene.views]
    write_model(run.refined_path, images, points, scene.point_colors)
    if scene.georeference is not None:
        atomic_write(run.refined_path / GEOREFERENCE_FILE, scene.georeference.content())
    degrees, shifts = poses.motions()
    far = (degrees > POSE_WARNING_DEGREES) | (shifts > POSE_WARNING_UNITS * scene.length_unit)
    if far.any():
        names = [view.name for view, one in zip(scene.train_views, far, strict=True) if one]
        warnings.warn(
            f"--refine-poses: the cameras of {examples(names)} have moved by up to {degrees.max():.1f} degrees and "
            f"{shifts.max():.3g} world units; check the renders of these photographs, or leave them out"
        )
    if (most := lenses.largest) > LENS_WARNING_FOCAL_LENGTHS:
        warnings.warn(
            f"--refine-lenses: a focal length or principal point has changed by {most:.1%} of the focal length; "
            "check the renders, or train without --refine-lenses"
        )


def doubt_poses(mean: Mapping[str, float], most: float) -> None:
    """Warn if held-out views score over `most` dB better at aligned poses than at their given poses, because the model
    has then moved away from the given cameras.

    mean: mean scores of the held-out views by name, as in eval.json.
    """
    lost = mean.get("psnr_aligned", 0.0) - mean["psnr"]
    if 0 < most < lost:
        warnings.warn(
            f"--refine-poses: held-out views have {mean['psnr']:.2f} dB at their given poses and "
            f"{mean['psnr_aligned']:.2f} dB at the poses that fit best: the model has moved with the refined cameras. "
            "Use this model with the cameras in refined/; if the given cameras are good, train without --refine-poses"
        )
