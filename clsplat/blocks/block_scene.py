# SPDX-License-Identifier: Apache-2.0
"""The scenes of a block and of the finish: photographs of the whole scene, with the cameras of the coarse model."""

from __future__ import annotations

from dataclasses import replace

from clsplat.blocks.plan import Block, BlockPlan
from clsplat.camera import Camera
from clsplat.errors import InputError, examples
from clsplat.runs import scene_record
from clsplat.runs.run import Run
from clsplat.scenes.readers.colmap import read_cameras
from clsplat.scenes.scene import Scene, View


def scene_of_block(scene: Scene, plan: BlockPlan, block: Block, coarse: Run) -> Scene:
    """Return the block's training photographs as a scene. Length unit and extent are those of the whole scene.

    scene: the whole scene, which may lack photographs of other blocks.
    coarse: the coarse model's run, whose refined cameras are used.
    """
    whole = scene_of_finish(scene, plan, coarse)
    there = {view.name: view for view in whole.train_views}
    return replace(
        whole,
        name=f"{scene.name}, block {block.shown}",
        views=[there[name] for name in sorted(block.photographs)],
    )


def scene_of_finish(scene: Scene, plan: BlockPlan, coarse: Run) -> Scene:
    """Return the whole scene with the length unit of the coarse model's training, and any refined cameras.

    Its extent is that in the plan, since the cameras of the scene may be fewer, or refined.
    Held-out views keep their given poses, as in the evaluation of every training.
    """
    record = scene_record.read(coarse)
    unit = None if record is None else scene_record.length_unit_of(record)
    scene = replace(scene, unit=unit, whole_extent=plan.extent)
    if not coarse.config.refines:
        return scene
    refined = read_cameras(coarse.refined_path, coarse.config.lenses)
    if missing := [view.name for view in scene.train_views if view.name not in refined]:
        raise InputError(
            f"{coarse.refined_path}: lacks the cameras of {len(missing)} photographs ({examples(missing)}), expected "
            "those of all training photographs"
        )
    views = [
        replace(view, camera=_refined(view, refined[view.name], coarse)) if view.name in refined else view
        for view in scene.views
    ]
    return replace(scene, views=views)


def _refined(view: View, refined: Camera, coarse: Run) -> Camera:
    """Return the view's camera with the pose, and the intrinsics if lenses were refined, of a refined camera."""
    camera, lens = view.camera, refined.resized(view.camera.width, view.camera.height)
    if coarse.config.refine_lenses:
        camera = replace(camera, fx=lens.fx, fy=lens.fy, cx=lens.cx, cy=lens.cy)
    return camera.posed(refined.rotation, refined.translation) if view.split == "train" else camera
