# SPDX-License-Identifier: Apache-2.0
"""The experiment of view orders: the price of training near views one after another, and how much they share."""

from __future__ import annotations

from argparse import Namespace
from itertools import pairwise

import numpy as np
from quality.trainings import Rows, trained

from clsplat.config.training import TrainConfig
from clsplat.device.buffers import upload
from clsplat.device.selection import open_device
from clsplat.gaussians import Gaussians
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.stages.device_gaussians import upload_gaussians
from clsplat.training.preparation import prepared
from clsplat.training.step.view_order import ViewOrder

PASSES = 2
"""Passes whose successive views are compared."""


def orders(given: Namespace) -> Rows:
    """Held-out PSNR of scenes trained with --view-order random and near, with several seeds.

    The last column is the share of the Gaussians in view that the view before has shown, the mean over two passes
    through the training views. The model is that of the last training, the sizes are those of the photographs.
    """
    yield "scene", "order", "PSNR, dB", "of the seeds", "Gaussians", "in view", "shared"
    for path in given.scenes:
        scene = prepared(load_scene(path, resolution=given.resolution), TrainConfig())
        for order in ("random", "near"):
            rows = [trained(given, f"{path.name} {order}", path, seed=seed, view_order=order) for seed in given.seeds]
            psnr = [row.last["mean"]["psnr"] for row in rows]
            count = np.mean([row.last["gaussians"] for row in rows])
            in_view, shared = shares(scene, rows[-1].model, near=order == "near")
            cells = f"{np.mean(psnr):.3f}", ", ".join(f"{each:.2f}" for each in psnr), f"{count:,.0f}"
            yield path.name, order, *cells, f"{in_view:.1%}", f"{shared:.1%}"
    return 0


def shares(scene: Scene, gaussians: Gaussians, *, near: bool) -> tuple[float, float]:
    """Mean share of a model's Gaussians that a training view shows, and of these that the view before has shown."""
    order = ViewOrder([view.camera for view in scene.train_views], scene.length_unit, near=near)
    rng, device = np.random.default_rng(0), open_device()
    rasterizer, model = Rasterizer(device, antialiased=gaussians.antialiased), upload_gaussians(device, gaussians)
    background = upload(device, np.zeros(3, np.float32))
    shown = {}
    for index, view in enumerate(scene.train_views):
        frame = rasterizer.forward(model, gaussians.local(view.camera), background, backward=False)
        shown[index] = frame.projected.tile_counts.get() > 0
    queue = [view for _ in range(PASSES) for view in order.next_pass(rng)]
    common = [np.count_nonzero(shown[a] & shown[b]) / max(shown[b].sum(), 1) for a, b in pairwise(queue)]
    return float(np.mean([each.mean() for each in shown.values()])), float(np.mean(common))
