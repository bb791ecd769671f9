# SPDX-License-Identifier: Apache-2.0
"""`clsplat info`: description of a model file."""

from __future__ import annotations

import json
from dataclasses import dataclass

from clsplat.cli.options import Flag, RunOrModel, Verb
from clsplat.cli.session import Services


@dataclass(frozen=True)
class InfoVerb(Verb):
    """Describe a model file: format, count, SH, bounds, scales, opacities, colour space and values that are not
    finite."""

    model: RunOrModel
    """A run's folder or a model file of any format."""
    json: Flag = False
    """Print the result as JSON."""


def run(verb: InfoVerb, _: Services) -> int:
    """Print the description of the model file."""
    from clsplat.models.info import model_info, text
    from clsplat.runs.run import model_file

    info = model_info(model_file(verb.model))
    print(json.dumps(info, indent=2) if verb.json else text(info))
    return 0
