# SPDX-License-Identifier: Apache-2.0
"""Refined cameras at the end of a training: a COLMAP model of them, and warnings where they went far."""

from __future__ import annotations

import warnings
from collections.abc import Mapping

from clsplat.errors import examples
from clsplat.runs.run import Run
from clsplat.scenes.colmap_writing import write_model
from clsplat.training.trainer import Trainer

FAR_DEGREES, FAR_PART = 5.0, 0.1
"""Degrees, and part of the scene's extent, beyond which a refined pose is told of."""
FAR_CHANGE = 0.1
"""The same of a lens, in focal lengths."""


def keep_cameras(run: Run, trainer: Trainer) -> None:
    """Write the refined cameras, with held-out poses and the points moved as these are on average; a warning for any
    that went far."""
    scene, poses, lenses = trainer.scene, trainer.cameras.poses, trainer.cameras.lenses
    cameras, points = {view.name: view.camera for view in scene.views}, scene.points
    if (along := trainer.cameras.drift()) is not None:
        cameras = {name: along.taken_along(camera) for name, camera in cameras.items()}
        points = along.points(points)
    cameras |= {view.name: camera for view, camera in zip(trainer.views, poses.cameras, strict=True)}
    images = [(view.name, lenses.refined(view.lens), cameras[view.name]) for view in scene.views]
    write_model(run.refined_path, images, points, scene.point_colors)
    degrees, shifts = poses.motions()
    far = (degrees > FAR_DEGREES) | (shifts > FAR_PART * scene.extent)
    if far.any():
        names = [view.name for view, one in zip(trainer.views, far, strict=True) if one]
        warnings.warn(
            f"--refine-poses: {examples(names)}: moved by up to {degrees.max():.1f} degrees and {shifts.max():.3g} "
            "world units; look at their renders, or leave them out"
        )
    if (most := lenses.largest) > FAR_CHANGE:
        warnings.warn(
            f"--refine-lenses: a focal length or principal point has changed by {most:.1%} of the focal length; look "
            "at the renders, or leave them as they are"
        )


def doubt_poses(mean: Mapping[str, float], most: float) -> None:
    """Warn where the model's world has left that of the cameras as they were given, by more than `most` dB."""
    lost = mean.get("psnr_aligned", 0.0) - mean["psnr"]
    if 0 < most < lost:
        warnings.warn(
            f"--refine-poses: held-out views have {mean['psnr']:.2f} dB where they were given and "
            f"{mean['psnr_aligned']:.2f} dB where they fit the model best: it has moved with the refined cameras. Use "
            "those of refined/ with it; where the given ones are good, train without --refine-poses"
        )
