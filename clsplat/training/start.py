# SPDX-License-Identifier: Apache-2.0
"""`Start`: a model that a training begins with, and what else the training takes from an earlier one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from clsplat.config.training import TrainConfig
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.optimisation.trained_region import TrainedRegion


@dataclass(frozen=True, eq=False)
class Start:
    """What a training begins with, in place of Gaussians from the scene's points.

    model: the initial Gaussians. None makes them from the scene's points.
    region: the region in which the training changes Gaussians. None means everywhere.
    appearance_of: folder of a run whose appearance is used for photographs of the same name, and is not trained. None
        means that the training has an appearance of its own.
    trains_appearance: True to train the appearance from where `appearance_of` has it.
    """

    model: Gaussians | None = None
    region: TrainedRegion | None = None
    appearance_of: Path | None = None
    trains_appearance: bool = False


NO_START = Start()
"""The start of a training from the scene's points."""


def check_start(start: Start, config: TrainConfig) -> None:
    """Raise InputError if a training with the settings `config` cannot begin with `start`."""
    if not isinstance(start, Start):
        raise InputError(f"start is {start!r:.100}, expected Start(model=..., region=...)")
    model, region = start.model, start.region
    if region is not None and model is None:
        raise InputError("start has a region but no model, expected the model whose Gaussians the region selects")
    if region is not None and config.refines:
        raise InputError(
            "start has a region, and the settings refine cameras: only the whole scene can refine them, so expected "
            "refine_poses=False and refine_lenses=False"
        )
    if model is None:
        return
    try:
        model.check()
    except ValueError as error:
        raise InputError(f"start: the model's {error}") from None
    if model.sh_degree > config.sh_degree:
        raise InputError(
            f"start: the model has SH degree {model.sh_degree}, expected at most sh_degree {config.sh_degree} of the "
            "settings"
        )
    if model.antialiased != config.antialiased:
        raise InputError(
            f"start: the model was trained with antialiased={model.antialiased}, the settings have "
            f"antialiased={config.antialiased}; expected the same"
        )
    if not len(model) or (region is not None and not region.contains(model.means, model.origin).any()):
        place = "" if region is None else " in the region"
        raise InputError(f"start: the model of {len(model):,} Gaussians has none{place}, expected at least one")
