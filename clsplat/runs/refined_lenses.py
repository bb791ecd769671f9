# SPDX-License-Identifier: Apache-2.0
"""Views with the lenses that a run has refined (--refine-lenses), for evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from clsplat.runs.run import Run
from clsplat.scenes.readers.colmap import read_cameras
from clsplat.scenes.scene import View


def through_refined(views: Sequence[View], run: Run | None) -> list[View]:
    """Return copies of the views with the lenses that `run` has refined; poses stay. Raises InputError.

    The views are returned unchanged if `run` is None or has refined no lenses. The finish of a scene in blocks refines
    nothing, but has the refined cameras of the coarse model.
    """
    if run is None or not run.refined_path.is_dir() or (run.config.refine_poses and not run.config.refine_lenses):
        return list(views)
    cameras, seen = read_cameras(run.refined_path, run.config.lenses), []
    for view in views:
        if (found := cameras.get(view.name)) is None:
            seen.append(view)
            continue
        lens = found.resized(view.camera.width, view.camera.height)
        seen.append(replace(view, camera=replace(view.camera, fx=lens.fx, fy=lens.fy, cx=lens.cx, cy=lens.cy)))
    return seen
