# SPDX-License-Identifier: Apache-2.0
"""The coarse model of a whole scene: settings of its training, and the number of steps of a block and of the finish."""

from __future__ import annotations

from dataclasses import replace

from clsplat.config.colour_models import appearance_rate_of_part
from clsplat.config.presets import STEP_SETTINGS, stretched
from clsplat.config.training import TrainConfig

COARSE_STEPS_SHARE = 0.15
"""Steps of the coarse model's training, as a fraction of the steps of the whole."""
COARSE_SIZE = 0.5
"""Size of the photographs from which the coarse model is trained, as a fraction of their size in the whole."""
MIN_DENSIFICATIONS = 8
"""Least number of densifications of the coarse model, if its schedule has as many steps between start and stop."""
SKY_PASSES_SHARE = 0.25
"""Passes of the sky's block through its photographs, as a fraction of the passes of the other blocks. All of them gain
0.04 dB in the town of docs/scale.md."""
FINISH_STEPS_SHARE = 0.05
"""Steps over all photographs after the merge, as a fraction of the steps of the whole."""


def coarse_settings(config: TrainConfig, longest: int) -> TrainConfig:
    """Return the settings of the coarse model's training.

    config: settings of the training of the whole.
    longest: longest side of the photographs at the size of the whole, in pixels.
    The schedule is shortened, with three exceptions. The number of steps between densifications stays, unless there
    would be fewer than MIN_DENSIFICATIONS. Opacities are not reset, because the training is too short to recover from a
    reset. This also turns off pruning by size. With a white background, opacities are still reset once, at
    density.start.
    Gains take steps as large as in the whole's training: a short training would take larger ones, too large for the few
    steps in which a photograph is shown.
    """
    short = stretched(config, coarse_steps(config), [name for name in STEP_SETTINGS if name != "density.every"])
    span = short.density.stop - short.density.start
    every = min(short.density.every, max(span // MIN_DENSIFICATIONS, 1))
    density = replace(short.density, opacity_reset_every=0, every=every)
    if density.fills:  # pictures of half the size show a quarter of the pixels
        density = replace(density, max_gaussians=max(round(COARSE_SIZE**2 * density.max_gaussians), 1))
    return replace(
        short,
        resolution=max(round(COARSE_SIZE * longest), 1),
        eval_at=(),
        appearance_rate=appearance_rate_of_part(
            config.appearance_rate, config.appearance, config.iterations, short.iterations
        ),
        density=density,
    )


def without_density_control(config: TrainConfig) -> list[str]:
    """Return a warning if blocks have no density control, because that of the whole stops before; else an empty list.

    config: settings of the training of the whole.
    """
    density, passed = config.density, coarse_steps(config)
    if density.every == 0 or density.stop > passed:
        return []
    known = (
        f"density.stop is {density.stop}, but blocks begin after step {passed}, where the coarse model's training ends"
    )
    return [f"{known}: blocks add and remove no Gaussians; expected --density.stop above {passed}"]


def coarse_steps(config: TrainConfig) -> int:
    """Number of steps of the coarse model's training. config: settings of the training of the whole."""
    return max(round(COARSE_STEPS_SHARE * config.iterations), 1)


def block_steps(config: TrainConfig, photographs: int, of: int) -> int:
    """Number of steps of a block: the passes that the coarse model's training leaves, through the block's photographs.

    config: settings of the training of the whole.
    photographs: number of the block's photographs.
    of: number of the scene's training photographs.
    """
    return max(round(photographs * (config.iterations - coarse_steps(config)) / of), 1)


def sky_steps(config: TrainConfig, photographs: int, of: int, most: int) -> int:
    """Number of steps of the sky's block. config, photographs, of: as for `block_steps`.

    most: limit, so that the sky of a scene in many blocks takes no more steps than its largest block.
    """
    return max(min(round(SKY_PASSES_SHARE * block_steps(config, photographs, of)), most), 1)


def finish_steps(config: TrainConfig) -> int:
    """Number of steps over all photographs after the merge. config: settings of the training of the whole."""
    return max(round(FINISH_STEPS_SHARE * config.iterations), 1)
