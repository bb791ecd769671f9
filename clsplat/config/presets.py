# SPDX-License-Identifier: Apache-2.0
"""Bundles of settings: --preset (exact, default, fast), --schedule (paper, short, high-rates), and --passes."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from operator import attrgetter
from typing import Literal

from clsplat.config.checks import misfit
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.config.training import DensityConfig, OptimiserConfig, TrainConfig
from clsplat.errors import InputError

Preset = Literal["exact", "default", "fast"]
Schedule = Literal["paper", "short", "high-rates"]
RASTERIZER_PRESETS: dict[Preset, RasterizerConfig] = {
    "exact": RasterizerConfig(),
    "default": RasterizerConfig(),
    "fast": RasterizerConfig(alpha_min=2 / 255, transmittance_min=1e-3),
}
"""Rasterizer settings by preset.

exact: no approximations.
default: the default settings. They equal exact, because no default approximates anything.
fast: approximations that are worth their error (docs/performance.md).
"""


def scheduled(schedule: Schedule, iterations: int) -> TrainConfig:
    """Return the training settings of a schedule, which flags of `clsplat train` may override.

    paper: the default settings, whatever `iterations` is. They are meant for 30,000 steps.
    short: for runs of about 7000 steps, which the paper's rates leave unfinished. Colours, opacities and rotations
    learn faster, and SH degrees rise twice as fast. The means' rate reaches its minimum at the last step. Density
    control ends at five sevenths, and the last seventh is a cooldown (docs/decisions/0013-a-short-schedule.md).
    high-rates: like short, but with higher rates of means, sizes, rotations and higher SH bands, and a cooldown to
    lower rates. SH degrees rise every 300 steps, and mcmc has less noise (docs/decisions/0031-high-rates.md).
    """
    if schedule == "paper":
        return TrainConfig(iterations=iterations)
    config = TrainConfig(
        iterations=iterations,
        sh_degree_every=500,
        optimiser=OptimiserConfig(
            means_rate_steps=max(iterations, 1),
            sh_dc_rate=4e-3,
            sh_rest_rate=4e-4,
            opacities_rate=0.05,
            quaternions_rate=2e-3,
            cooldown=max(iterations // 7, 0),
            cooldown_to=0.2,
        ),
        density=DensityConfig(stop=max(5 * iterations // 7, 0)),
    )
    if schedule == "short":
        return config
    return replace(
        config,
        sh_degree_every=300,
        optimiser=replace(
            config.optimiser,
            means_rate=3.2e-4,
            means_rate_end=1.6e-5,
            sh_rest_rate=1.6e-3,
            scales_rate=0.01,
            quaternions_rate=4e-3,
            cooldown_to=0.05,
        ),
        density=replace(config.density, noise_rate=2e5),
    )


STEPS_MADE_FOR: dict[Schedule, int] = {"paper": 30_000, "short": 7000, "high-rates": 7000}
"""Number of training steps that each schedule is made for."""
STEP_SETTINGS = (
    "iterations",
    "sh_degree_every",
    "warmup",
    "optimiser.means_rate_steps",
    "optimiser.cooldown",
    "density.every",
    "density.start",
    "density.stop",
    "density.opacity_reset_every",
    "density.prune_every",
)
"""Settings of the schedule that count steps. `--passes` scales them."""


def steps_made_for(preset: Preset, schedule: Schedule | None) -> int:
    """Number of training steps for which the settings of a preset and a schedule are made."""
    return STEPS_MADE_FOR[schedule or ("short" if preset == "fast" else "paper")]


def by_passes(config: TrainConfig, passes: int, photographs: int, given: Collection[str] = ()) -> TrainConfig:
    """Stretch or shorten the schedule in `config` to `passes` passes through the training photographs.

    All STEP_SETTINGS are multiplied by the same factor, so that a densification sees the same fraction of the
    photographs, whatever their number. A setting of at least 1 stays at least 1.
    photographs: number of training photographs.
    given: names of settings that must not change.
    Raises InputError if `passes` is less than 1.
    """
    if expected := misfit(int, passes) or ("" if passes >= 1 else "at least 1"):
        raise InputError(f"--passes {passes}: expected {expected}")
    return stretched(config, passes * photographs, [name for name in STEP_SETTINGS if name not in given])


def stretched(config: TrainConfig, iterations: int, names: Collection[str] = STEP_SETTINGS) -> TrainConfig:
    """Stretch or shorten the schedule in `config` to `iterations` steps. A setting of at least 1 stays at least 1.

    names: the settings to multiply, of STEP_SETTINGS.
    """
    factor = iterations / config.iterations

    def scaled(steps: int) -> int:
        return max(round(factor * steps), 1) if steps else 0

    for name in names:
        steps = attrgetter(name)(config)
        value = tuple(sorted({scaled(step) for step in steps})) if isinstance(steps, tuple) else scaled(steps)
        config = config.changed(name, value)
    return config


def bundled(preset: Preset, schedule: Schedule | None, iterations: int) -> TrainConfig:
    """Return the training settings of a preset and a schedule, which flags of `clsplat train` may override.

    schedule: None means short for fast, and paper for the other presets.

    fast saves time by less work in a step. Photographs have a quarter of their width and height for the first 1/14 of
    the steps, and half until 2/7 of the steps. There are fewer Gaussians: the gradient threshold is higher, and
    splits are along the longest axis. Gaussians that add less than a tenth of a pixel to every view are pruned. Means,
    scales and rotations have two to four times the schedule's rates. The higher SH bands are updated in every second
    step. The rasterizer has the approximations of RASTERIZER_PRESETS (docs/decisions/0015-the-fast-preset.md).

    Raises InputError for fast with high-rates.
    """
    if preset == "fast" and schedule == "high-rates":
        raise InputError(
            "--preset fast and --schedule high-rates exclude each other: fast raises the short schedule's rates"
        )
    config = scheduled(schedule or ("short" if preset == "fast" else "paper"), iterations)
    config = replace(config, rasterizer=RASTERIZER_PRESETS[preset])
    if preset != "fast":
        return config
    optimiser = config.optimiser
    return replace(
        config,
        warmup=tuple(sorted({max(iterations // 14, 1), max(2 * iterations // 7, 1)})),
        optimiser=replace(
            optimiser,
            means_rate=2 * optimiser.means_rate,
            scales_rate=4 * optimiser.scales_rate,
            quaternions_rate=2 * optimiser.quaternions_rate,
            sh_rest_every=2,
        ),
        density=replace(config.density, gradient_threshold=3e-4, min_contribution=0.1, long_axis=True),
    )
