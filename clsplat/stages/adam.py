# SPDX-License-Identifier: Apache-2.0
"""Launches adam.cl for every parameter group. In a step of one view, `stages.project.project_step` updates the
parameters instead.

Betas, epsilon and learning rates are settings: `OptimiserConfig` in `config/training.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import DeviceArray, allocate
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.layouts.columns import READBACK
from clsplat.stages.chunk_lists import ChunkList
from clsplat.stages.device_gaussians import DeviceGaussians


@dataclass(eq=False)
class AdamStep:
    """A step of Adam: settings, the step's number (from 1), and the learning rate of each parameter group."""

    config: OptimiserConfig
    number: int
    rates: Mapping[str, float]

    @property
    def updates_sh_rest(self) -> bool:
        """True if the step updates the higher SH bands."""
        return self.number % self.config.sh_rest_every == 0

    def corrected(self, group: str) -> tuple[float, float]:
        """Return learning rate / (1 - beta1^t) and 1 / sqrt(1 - beta2^t), where the step is the group's t-th update."""
        shrunk, root = self.corrections(self.number if group != "sh_rest" else self.number // self.config.sh_rest_every)
        return self.rates[group] / shrunk, root

    def corrections(self, update: int) -> tuple[float, float]:
        """Return 1 - beta1^t and 1 / sqrt(1 - beta2^t) for a group's update number t = `update`, counted from 1."""
        return 1.0 - self.config.beta1**update, (1.0 - self.config.beta2**update) ** -0.5

    @property
    def scales(self) -> dict[str, float]:
        """Step size of each parameter group in its t-th update: rate * sqrt(1 - beta2^t) / (1 - beta1^t). Groups that
        this step does not update are left out."""
        groups = [group for group in self.rates if group != "sh_rest" or self.updates_sh_rest]
        by_group = {group: self.corrected(group) for group in groups}
        return {group: rate / root for group, (rate, root) in by_group.items()}


@stage("adam", adam=4)
def adam(
    device: Device,
    step: AdamStep,
    parameters: DeviceGaussians,
    gradients: DeviceGaussians,
    first: DeviceGaussians,
    second: DeviceGaussians,
    tile_counts: DeviceArray | None = None,
    readback: DeviceArray | None = None,
    chunks: ChunkList | None = None,
) -> None:
    """Update the parameters by Adam, and set the gradients to zero.

    gradients: gradients of all rows, or of the rows of `chunks`.
    first, second: Adam's moments.
    chunks: the chunks of the model that the step updates; None for the whole model. Not with `OptimiserConfig.late`.
    tile_counts: (n,) uint32, 0 for a Gaussian that the view does not show; needed if `OptimiserConfig.late` is set.
    readback: (READBACK_SIZE,) uint32. Its last four entries count the elements that were not updated, by reason
    (`columns.REFUSED`). None discards these counts.
    """
    readback = readback or allocate(device, (len(READBACK),), np.uint32)
    counts = readback.buffer  # a plain buffer: the profile must not count readback's bytes, which are rarely written
    config = step.config
    beta1, beta2, epsilon = config.beta1, config.beta2, config.epsilon
    abreast = max(device.shape.lanes, 4)  # number of elements per work-item, ABREAST in adam.h
    for group, about in PARAMETER_GROUPS.items():
        if group == "sh_rest" and not step.updates_sh_rest:
            continue
        rate, root = step.corrected(group)
        constants = (rate, root, beta1, beta2, epsilon, about.limit**2, counts)
        arrays = (parameters[group], gradients[group], first[group], second[group])
        size, rows = gradients[group].size, gradients.count
        if size == 0:
            continue
        if config.late:
            assert tile_counts is not None, "optimiser.late needs the tile counts of a view"
            assert chunks is None, "optimiser.late steps over the whole model"
            kernel = device.kernels("adam", {"WIDTH": size // rows}).adam_visible
            launch_items(device, kernel, -(-rows // abreast), rows, *constants, tile_counts, *arrays)
        else:
            defines: dict[str, object] = {"SPARSE": True} if config.sparse else {}
            if chunks is not None:
                defines |= {"WIDTH": size // rows, "CHUNKS": True}
            kernel = device.kernels("adam", defines).adam
            # With 95 million Gaussians or more, an index of an SH coefficient needs more than 32 bits.
            numbers = (np.uint64(size), *constants)
            launch_items(device, kernel, -(-size // abreast), *numbers, *arrays, *_listed(chunks))


def _listed(chunks: ChunkList | None) -> tuple[object, ...]:
    """Arguments CHUNK_PARAMETERS of kernels/shared/chunks.h, with a plain buffer, because the profile assumes that a
    kernel updates the arrays at the end of its arguments. Empty without chunks."""
    return () if chunks is None else (chunks.numbers.buffer, chunks.model_rows)


@stage("adam", add_view=1)
def add_view(
    device: Device,
    tile_counts: DeviceArray,
    gradients: DeviceGaussians,
    sums: DeviceGaussians,
    *,
    sh_rest: bool = True,
    places: ChunkList | None = None,
) -> None:
    """Add the gradients of the Gaussians visible in a view to the sums over the earlier views.

    tile_counts: (n,) uint32, tile counts in the view; 0 for a Gaussian that is not visible.
    sh_rest: also add the gradients of the higher SH bands.
    places: for each chunk of the view its place among the chunks of `sums`; None if `sums` has the rows of the view.
    """
    rows = tile_counts.shape[0]
    for group in PARAMETER_GROUPS:
        width = sums[group].size // sums.count
        if width and (sh_rest or group != "sh_rest"):
            defines: dict[str, object] = {"WIDTH": width, **({} if places is None else {"CHUNKS": True})}
            kernel, arrays = device.kernels("adam", defines).add_view, (tile_counts, gradients[group], sums[group])
            launch_items(device, kernel, rows * width, np.uint64(rows * width), *arrays, *_listed(places))
