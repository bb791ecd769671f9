# SPDX-License-Identifier: Apache-2.0
"""Disturbed poses or lenses, and how far training brings them back (`--refine-poses`, `--refine-lenses`).

    .venv/bin/python tools/quality_poses.py FOLDER [--scene SCENE] [--width 120] [--photos 40] [--points 5000]
        [--iterations 7000] [--degrees 0.5] [--percent 1] [--seed 0] [--reach DEGREES] [--lens PERCENT]

The scene is the demo's, whose poses are exact, or SCENE at --width. All training poses but the two that are held are
turned by --degrees about random axes and shifted by --percent of the extent. Trained are the scene as it is, the
disturbed one, and that with its poses refined. The table has mean errors of the disturbed poses, and PSNR on held-out
views, with their own poses and with those that fit the model best. With --lens poses stay, and focal length and
principal point, across, are off by so many hundredths of the focal length, which the run can refine by 2.5 times that.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from quality_points import demo, write_scene

from clsplat.camera import Camera
from clsplat.config.training import TrainConfig
from clsplat.device.context import open_device
from clsplat.evaluation.held_out import evaluate
from clsplat.images.alpha import background_colour
from clsplat.rendering.renderer import Renderer
from clsplat.runs.appearance import held_out_looks
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene, View
from clsplat.training.cameras import aligned
from clsplat.training.poses import Poses
from clsplat.training.trainer import Trainer


def disturbed(scene: Scene, degrees: float, percent: float, seed: int) -> Scene:
    """The scene with its training poses off, but for two."""
    rng = np.random.default_rng(seed)
    train = [view.name for view in scene.train_views]
    held = {train[index] for index in Poses(TrainConfig(refine_poses=True), scene.train_views, scene.extent).held}

    def off(view: View) -> View:
        axis, direction = (each / np.linalg.norm(each) for each in rng.standard_normal((2, 3)))
        if view.name not in train or view.name in held:
            return view
        motion = np.concatenate([np.radians(degrees) * axis, percent / 100 * scene.extent * direction])
        return replace(view, camera=view.camera.moved(motion))

    return replace(scene, views=[off(view) for view in scene.views])


def refocused(scene: Scene, part: float) -> Scene:
    """The scene with every focal length and principal point off by this part of the focal length."""
    views = []
    for view in scene.views:
        change = (part, part, 0.0)
        views.append(replace(view, camera=view.camera.refocused(*change), lens=view.lens.refocused(*change)))
    return replace(scene, views=views)


def errors(found: list[Camera], true: list[Camera]) -> tuple[float, float]:
    """Mean degrees and world units by which poses that were disturbed are off; two are not."""
    cosines = [(np.trace(a.rotation @ b.rotation.T) - 1) / 2 for a, b in zip(found, true, strict=True)]
    shifts = [np.linalg.norm(a.position - b.position) for a, b in zip(found, true, strict=True)]
    count = len(true) - 2
    return float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).sum()) / count, float(np.sum(shifts)) / count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scene", type=Path)
    for flag, value in (
        *(("--width", 120), ("--photos", 40), ("--points", 5000), ("--iterations", 7000), ("--seed", 0)),
        *(("--degrees", 0.5), ("--percent", 1.0), ("--reach", TrainConfig.pose_reach), ("--lens", 0.0)),
    ):
        parser.add_argument(flag, type=type(value), default=value)
    options = parser.parse_args()
    if options.scene is None:
        path = options.folder / "scene"
        if not (path / "transforms.json").exists():
            views, pictures, depths = demo(options.width, options.photos, options.seed)
            write_scene(path, views, pictures, depths, (options.points, options.points), options.seed)
        scene = load_scene(path)
    else:
        scene = load_scene(options.scene, resolution=options.width)
    if options.lens:
        off = refocused(scene, options.lens / 100)
    else:
        off = disturbed(scene, options.degrees, options.percent, options.seed)
    true, extent = [view.camera for view in scene.train_views], scene.extent
    plain = TrainConfig(iterations=options.iterations, seed=options.seed)
    of_lens = {"refine_lenses": True, "lens_reach": 2.5 * options.lens}
    of_poses = {"refine_poses": True, "pose_reach": options.reach}
    refined = replace(plain, **(of_lens if options.lens else of_poses))
    print(f"{len(true)} training views, extent {extent:.3g}\n")
    print("trained          degrees  % of extent  PSNR own  PSNR aligned", flush=True)
    for name, subject, config in (("as it is", scene, plain), ("disturbed", off, plain), ("refined", off, refined)):
        trainer = Trainer(subject, config, open_device())
        while trainer.step < config.iterations:
            trainer.train_step()
        trainer.finish()
        renderer = Renderer(trainer.device, config=config.rasterizer)
        means = []
        for camera_of in (
            lambda view: view.camera,
            lambda view, trainer=trainer: aligned(trainer, view, held_out_looks(None)),
        ):
            background = background_colour(config.background)

            def draw(view, camera_of=camera_of, trainer=trainer, background=background, renderer=renderer):
                return renderer.render(trainer.parameters, trainer.local(camera_of(view)), background).image

            numbers = {"step": trainer.step, "gaussians": trainer.parameters.count, "seconds": None}
            views = trainer.cameras.lenses.of_views(subject.test_views)
            means.append(evaluate(draw, views, background, **numbers)["mean"]["psnr"])
        degrees, shift = errors(trainer.cameras.poses.cameras, true)
        print(f"{name:15} {degrees:8.3f} {100 * shift / extent:12.3f} {means[0]:9.2f} {means[1]:13.2f}", flush=True)
        for log, x, y in trainer.cameras.lenses.changes if config.refine_lenses else ():
            moved = f"principal point {x:+.2%} across, {y:+.2%} down"
            print(f"the focal length has changed by {np.expm1(log):+.2%}, the {moved}")
        trainer.close()


if __name__ == "__main__":
    main()
