# SPDX-License-Identifier: Apache-2.0
"""`clsplat demo`: the whole pipeline on a scene of its own."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Annotated

from tyro.conf import arg

from clsplat.cli.options import DeviceChoice, Flag, Output, Verb
from clsplat.cli.session import Services
from clsplat.config.training import TrainConfig
from clsplat.config.verbs import DEMO_ITERATIONS


@dataclass(frozen=True)
class Demo(Verb):
    """Make photographs of a small scene, recover their cameras, train, evaluate and render a turntable."""

    output: Output
    """Folder for everything the demo makes: a new one, or one that a demo has made, which is made anew."""
    iterations: int = DEMO_ITERATIONS
    """Training steps. A few hundred show that all works, and less of the scene."""
    device: Annotated[DeviceChoice, arg(name="")] = field(default_factory=DeviceChoice)
    json: Flag = False
    """Print the evaluation as JSON on standard output."""


def run(verb: Demo, services: Services) -> int:
    """Run the demo, after the device's self-test."""
    TrainConfig(iterations=verb.iterations).check()
    verb.device.trusted(services)
    result = services.run_demo(verb.output, device=verb.device.selector, iterations=verb.iterations)
    if verb.json:
        print(json.dumps(result, indent=2))
    return 0
