# SPDX-License-Identifier: Apache-2.0
"""`Start`: the model and the region that a training begins with, and their checks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.config.training import TrainConfig
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.optimisation.trained_region import TrainedRegion
from clsplat.runs.checkpoints import Checkpoint


@dataclass(frozen=True, eq=False)
class Start:
    """Start of a training from a model, in place of Gaussians from the scene's points.

    model: the initial Gaussians. None makes them from the scene's points.
    region: the region in which the training changes Gaussians. None means everywhere. `train` leaves
        pixels that show frozen Gaussians out of the loss (`training.region_masks`).
    appearance_of: folder with the appearance.json (and appearance.npz) of an earlier training, whose appearance the
        photographs of the same names begin with. Its mean over the photographs stays. With `region`, the
        vignettes of lenses stay too. None begins as if nothing had been learnt.
    """

    model: Gaussians | None = None
    region: TrainedRegion | None = None
    appearance_of: Path | None = None


NO_START = Start()
"""The start of a training from the scene's points."""


def check_start(start: Start, config: TrainConfig) -> None:
    """Raise InputError if a training with the settings `config` cannot begin with `start`."""
    if not isinstance(start, Start):
        raise InputError(f"start is {start!r:.100}, expected Start(model=..., region=...)")
    model, region = start.model, start.region
    if start.appearance_of is not None and config.appearance == "none":
        raise InputError(
            f"start: has appearance_of={str(start.appearance_of)!r}, and the settings learn no appearance; expected "
            "the setting `appearance` of that training"
        )
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


def region_state(region: TrainedRegion | None) -> dict[str, Any]:
    """Return the JSON state that a checkpoint has for the region of the training; empty without one."""
    if region is None:
        return {}
    edges = [[None if np.isinf(edge) else edge for edge in side.tolist()] for side in (region.low, region.high)]
    return {
        "region": {
            "axes": region.axes.tolist(),
            "low": edges[0],
            "high": edges[1],
            "centre": region.centre.tolist(),
            "nearest": region.nearest,
            "farthest": None if np.isinf(region.farthest) else region.farthest,
        }
    }


def region_of(state: Mapping[str, Any] | None) -> TrainedRegion | None:
    """Return the region of the JSON state that `region_state` has under "region"; None for None."""
    if state is None:
        return None
    low, high = (
        [end if edge is None else edge for edge in state[side]] for side, end in (("low", -inf), ("high", inf))
    )
    farthest = inf if state["farthest"] is None else state["farthest"]
    centre = np.array(state["centre"])
    return TrainedRegion(np.array(state["axes"]), np.array(low), np.array(high), centre, state["nearest"], farthest)


def check_region(checkpoint: Checkpoint, region: TrainedRegion | None) -> None:
    """Raise InputError if a checkpoint was written with another region than `region`."""
    saved, now = checkpoint.state.get("region"), region_state(region).get("region")
    if saved != now:
        of, this = ("the whole scene" if each is None else f"the region {each}" for each in (saved, now))
        raise InputError(
            f"checkpoint of step {checkpoint.step}: was written by a training of {of}, and this training is of {this}; "
            "continue with the command that began the training"
        )
