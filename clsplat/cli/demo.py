# SPDX-License-Identifier: Apache-2.0
"""`clsplat demo`: the whole pipeline on a synthetic scene."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Annotated

from tyro.conf import arg

from clsplat.cli.options import DeviceChoice, Flag, Output, Verb
from clsplat.cli.session import Services
from clsplat.config.cli_defaults import DEMO_ITERATIONS
from clsplat.config.training import TrainConfig


@dataclass(frozen=True)
class DemoVerb(Verb):
    """Make photographs of a small scene, recover their cameras, train, evaluate and render a turntable."""

    output: Output
    """Folder for all results: a new folder, or the folder of an earlier demo, whose content is replaced."""
    iterations: int = DEMO_ITERATIONS
    """Training steps. A few hundred are enough to test the pipeline, but show less of the scene."""
    device: Annotated[DeviceChoice, arg(name="")] = field(default_factory=DeviceChoice)
    json: Flag = False
    """Print the evaluation as JSON on standard output."""


def run(verb: DemoVerb, services: Services) -> int:
    """Run the device's self-test, then the demo."""
    TrainConfig(iterations=verb.iterations).check()
    verb.device.trusted(services)
    result = services.run_demo(verb.output, device=verb.device.selector, iterations=verb.iterations)
    if verb.json:
        print(json.dumps(result, indent=2))
    return 0
