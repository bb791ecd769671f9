# SPDX-License-Identifier: Apache-2.0
"""The experiment of towns: scenes of growing size, and lengths in other units."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace
from functools import partial

import numpy as np
from quality.made_scenes import own_blocks, rescaled, single_blocks
from quality.trainings import Rows, Trained, call, picture_of, psnr_of, trained

from clsplat.device.selection import open_device
from clsplat.rendering.renderer import Renderer
from clsplat.runs.run import Run
from clsplat.runs.scene_record import length_unit_of, read
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene

BLOCK = "0000_0000/"
"""Beginning of the names of the photographs of a town's first block."""


def towns(given: Namespace) -> Rows:
    """Towns of growing size, then a town in metres, millimetres and kilometres. Each is trained with the length unit
    that follows from its depths, and again with its extent, where that differs.

    All towns have the same number of photographs and of Gaussians per block, and of passes. PSNR is that of all
    held-out photographs, of those of the first town's blocks, and of those of block 0, 0. With --own-block the growing
    towns' photographs count only where they show their own block. The first row then has the first town's blocks, each
    trained alone.
    """
    renderer = Renderer(open_device())
    yield "town", "metres a unit", "unit", "steps", "Gaussians", "PSNR, dB", "first town", "block 0, 0", "seconds"
    load, masks = (own_blocks, "masks=ignore") if given.own_block else (load_scene, "")
    towns = [(size, 1.0, load, masks) for size in given.towns.split(",")]
    for metres in (1.0, 1e-3, 1e3):
        scaled = load_scene if metres == 1 else lambda town, by=1 / metres: load_scene(rescaled(town, by))
        towns.append((given.scaled, metres, scaled, ""))

    def train(name: str, scene: Scene, masks: str) -> tuple[Trained, list[float]]:
        blocks = len({view.name.split("/")[0] for view in scene.views})
        limit = f"density.growth=budget,density.max-gaussians={given.sky + given.gaussians * blocks}"
        settings = ",".join([limit, f"sky={given.sky}", masks, given.settings])
        passes = {"iterations": given.iterations or None, "passes": None if given.iterations else given.passes}
        done = trained(given, name, scene, settings=settings, **passes)
        draw = partial(picture_of, renderer, done.model)
        shown = ([view for view in scene.test_views if view.name.startswith(part)] for part in ("", first, BLOCK))
        return done, [psnr_of(draw, views) if views else np.nan for views in shown]

    first: tuple[str, ...] = ()
    for size, metres, load, masks in towns:
        folder = given.folder / size
        if not folder.exists():
            town = "--town", size, "--town-photos", str(given.town_photos), "--town-size", given.town_size
            call(["demo", *town, "-o", str(folder)])
        scene = load(folder)
        if not first:
            first = tuple({f"{view.name.split('/')[0]}/" for view in scene.views})
            rows = [train(f"{block.name} alone", block, masks) for block in single_blocks(scene)] if masks else []
            if rows:
                of_all = (sum(done.last[name] for done, _ in rows) for name in ("step", "gaussians", "seconds"))
                steps, gaussians, seconds = of_all
                mean = f"{np.mean([psnr[0] for _, psnr in rows]):.2f}"
                alone = f"{steps:,}", f"{gaussians:,}", mean, mean, f"{rows[0][1][0]:.2f}", f"{seconds:.0f}"
                yield f"{size}, each block alone", "1", "", *alone
        for kind, unit in (("depths", None), ("extent", scene.extent)):
            done, psnr = train(f"{size} {metres:g} {kind}", replace(scene, unit=unit), masks)
            used = length_unit_of(read(Run.open(done.run)) or {}) or scene.extent
            cells = f"{used:.3g}", f"{done.last['step']:,}", f"{done.last['gaussians']:,}"
            yield size, f"{metres:g}", *cells, *(f"{each:.2f}" for each in psnr), f"{done.last['seconds']:.0f}"
            if used == scene.extent:
                break
    return 0
