# SPDX-License-Identifier: Apache-2.0
"""`clsplat info`: what a model file holds."""

from __future__ import annotations

import json
from dataclasses import dataclass

from clsplat.cli.options import Flag, RunOrModel, Verb
from clsplat.cli.session import Services


@dataclass(frozen=True)
class Info(Verb):
    """Say what a model file holds: format, count, SH, bounds, scales, opacities, colour space, what is not finite."""

    model: RunOrModel
    """A run's folder or a model file of any format."""
    json: Flag = False
    """Print the result as JSON."""


def run(verb: Info, _: Services) -> int:
    """Print it."""
    from clsplat.models.info import model_info, text
    from clsplat.runs.run import model_file

    info = model_info(model_file(verb.model))
    print(json.dumps(info, indent=2) if verb.json else text(info))
    return 0
