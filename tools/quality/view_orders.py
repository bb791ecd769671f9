# SPDX-License-Identifier: Apache-2.0
"""The experiment of view orders: how much quality near views cost, and how many Gaussians a step has to fetch."""

from __future__ import annotations

from argparse import Namespace
from itertools import pairwise

import numpy as np
from quality.trainings import Rows, trained

from clsplat.arrays import Bool
from clsplat.camera import Camera
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

PASSES = 3
"""Passes through the training views whose steps are compared."""
MOST_STEPS = 700
"""Number of these steps that are compared, at most."""
STORE = 0.5
"""Size of the store, relative to the model."""


def orders(given: Namespace) -> Rows:
    """Held-out PSNR of scenes trained with --view-order random and near, with several seeds.

    The last columns are of the last seed's model, at the photographs' size. "in view" is the share of its Gaussians
    that a view shows. "of them before" is the share of the Gaussians in view that the view before shows too. "fetched"
    is the share of the Gaussians in view that are fetched into a store of half the model. The store keeps the Gaussians
    that were in view last.
    """
    yield "scene", "order", "PSNR, dB", "of the seeds", "Gaussians", "in view", "of them before", "fetched"
    for path in given.scenes:
        scene = prepared(load_scene(path, resolution=given.resolution), TrainConfig())
        for name in ("random", "near"):
            rows = [trained(given, f"{path.name} {name}", path, seed=seed, view_order=name) for seed in given.seeds]
            psnr = [row.last["mean"]["psnr"] for row in rows]
            count = np.mean([row.last["gaussians"] for row in rows])
            cells = f"{np.mean(psnr):.3f}", ", ".join(f"{each:.2f}" for each in psnr), f"{count:,.0f}"
            cameras, rng = [view.camera for view in scene.train_views], np.random.default_rng(0)
            order = ViewOrder(cameras, scene.length_unit, near=name == "near")
            queue = [view for _ in range(PASSES) for view in order.next_pass(rng)]
            yield path.name, name, *cells, *(f"{share:.1%}" for share in shares(shown(scene, rows[-1].model), queue))
    return 0


def shown(scene: Scene, gaussians: Gaussians) -> Bool:
    """Mask (views, n) of the Gaussians that each training view shows."""
    device = open_device()
    rasterizer, model = Rasterizer(device, antialiased=gaussians.antialiased), upload_gaussians(device, gaussians)
    background = upload(device, np.zeros(3, np.float32))

    def of(camera: Camera) -> Bool:
        frame = rasterizer.forward(model, gaussians.local(camera), background, backward=False)
        return np.asarray(frame.projected.tile_counts.get() > 0)

    return np.array([of(view.camera) for view in scene.train_views])


def shares(seen: Bool, queue: list[int]) -> tuple[float, float, float]:
    """The last three columns of `orders`, as fractions.

    seen: from `shown`.
    queue: the order of views, as indices.
    """
    steps = range(1, min(len(queue), MOST_STEPS + 1))
    common = [np.count_nonzero(seen[a] & seen[b]) / max(seen[b].sum(), 1) for a, b in pairwise(queue)]
    total = sum(seen[queue[step]].sum() for step in steps)
    fetched = sum(np.count_nonzero(seen[queue[step]] & ~stored(seen, queue[:step])) for step in steps)
    return float(seen.mean()), float(np.mean(common)), float(fetched / max(total, 1))


def stored(seen: Bool, queue: list[int]) -> Bool:
    """Mask (n,) of the Gaussians in the store after the views of a queue: those of the last views that fit together."""
    held = np.zeros(seen.shape[1], bool)
    for view in reversed(queue):
        more = held | seen[view]
        if more.sum() > STORE * len(more):
            break
        held = more
    return held
