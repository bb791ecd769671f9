# SPDX-License-Identifier: Apache-2.0
"""`clsplat info`: description of a model file."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from clsplat.cli.options import Flag, RunOrModel, Verb
from clsplat.cli.session import Services


@dataclass(frozen=True)
class InfoVerb(Verb):
    """Describe a model file: format, count, SH, bounds, scales, opacities, colour space, place on the earth and
    values that are not finite."""

    model: RunOrModel
    """A run's folder or a model file of any format."""
    json: Flag = False
    """Print the result as JSON."""


def run(verb: InfoVerb, _: Services) -> int:
    """Print the description of the model file."""
    from clsplat.models.info import model_info, text
    from clsplat.runs.run import model_file
    from clsplat.scenes.geography.georeference import read_of_model

    info = model_info(model_file(verb.model))
    place = read_of_model(Path(info["path"]))
    if verb.json:
        print(json.dumps(info | {"georeference": None if place is None else place.document()}, indent=2))
    else:
        print(text(info, place=None if place is None else place.summary))
    return 0
