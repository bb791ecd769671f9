# SPDX-License-Identifier: Apache-2.0
"""`clsplat tune`: trial of the kernel shapes on a device, and choice of the quickest."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass, field
from typing import Annotated

from tyro.conf import arg

from clsplat.cli.options import DeviceChoice, Flag, Verb
from clsplat.cli.session import Services


@dataclass(frozen=True)
class TuneVerb(Verb):
    """Find a device's quickest kernel shape by a short trial, and save it for later runs.

    A shape sets how many pixels a work-item computes at once, and how many work-items share a tile. For the
    gradient's kernel, it also sets what these work-items divide among them: the tile's pixels or its Gaussians. A run
    is resumed, or reproduced to the byte, only with the shape it was trained with. CLSPLAT_SHAPE=LANESxITEMS overrides
    the saved shape.
    """

    device: Annotated[DeviceChoice, arg(name="")] = field(default_factory=DeviceChoice)
    forget: Flag = False
    """Delete the saved shape and return to the default one, without a trial."""
    json: Flag = False
    """Print the result as JSON."""


def run(verb: TuneVerb, _: Services) -> int:
    """Print the time of each kernel shape, and save the quickest."""
    from clsplat.bench.shapes import tune
    from clsplat.device.context import all_devices
    from clsplat.device.drivers.shapes import default_shape, save_shape, saved_path
    from clsplat.device.selection import find_device

    info = find_device(verb.device.selector)
    device = all_devices()[info.index]
    if verb.forget:
        save_shape(device, None)
        version, shape = info.version.split("  ")[0], default_shape(device)
        print(f"{info.name} ({version}): uses the default kernel shape, {shape}, from now on", file=sys.stderr)
        return 0
    trials, best = tune(device, info.index, lambda shape: print(f"trying {shape.words}", file=sys.stderr))
    if verb.json:
        records = [{**asdict(trial.shape), "ms": trial.ms} for trial in trials]
        document = {"device": info.name, "version": info.version, "best": asdict(best), "trials": records}
        print(json.dumps(document, indent=2))
        return 0
    width = max(len(trial.shape.words) for trial in trials)
    for trial in trials:
        text = "failed" if trial.ms is None else f"{trial.ms:8.2f} ms"
        mark = "  <- saved" if trial.shape == best else ""
        print(f"{trial.shape.words:{width}}  {text}{mark}")
    print(f"saved in {saved_path()}", file=sys.stderr)
    return 0
