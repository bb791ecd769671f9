# SPDX-License-Identifier: Apache-2.0
"""`clsplat capture`: from photographs or videos to a model, its report and pictures, by one command."""

from __future__ import annotations

import json
import shlex
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, Suppress, arg

from clsplat.cli.options import DeviceChoice, Flag, OptionalInt, Output, Verb
from clsplat.cli.session import Services
from clsplat.config.cli_defaults import CAPTURE_ITERATIONS
from clsplat.config.training import TrainConfig


@dataclass(frozen=True)
class CaptureVerb(Verb):
    """Turn photos or videos into a trained model, with its report, thumbnail and turntable.

    It does the work of clsplat sfm, train --auto, report, thumbnail and render, one after the other. After Ctrl-C the
    same command goes on in the stage that was interrupted.
    """

    input: Annotated[Positional[tuple[Path, ...]], arg(metavar="INPUT")]
    """A folder with photos, videos or both, searched with its sub-folders; or one or several videos."""
    output: Output
    """Folder for the results: frames/ of videos, scene/, run/, turntable/, report.html, thumbnail.png, capture.json."""
    frames: OptionalInt = None
    """Number of frames to take from each video, as with clsplat sfm --frames. If not given, the number follows from the
    video's length and motion."""
    iterations: int = CAPTURE_ITERATIONS
    """Training steps. If not given, the photographs' findings may change the number, as with clsplat train --auto."""
    device: Annotated[DeviceChoice, arg(name="")] = field(default_factory=DeviceChoice)
    overwrite: Flag = False
    """Replace the results of an earlier capture in the output folder. Stages whose input is the same are kept; if the
    whole call is the same, everything is made again."""
    json: Flag = False
    """Print the final evaluation as JSON on standard output."""
    given: Annotated[frozenset[str], Suppress] = field(default=frozenset(), compare=False)
    """Names of the settings given on the command line."""

    def completed(self, given: Collection[str]) -> CaptureVerb:
        """Return these arguments with the names of the flags given on the command line."""
        return replace(self, given=frozenset(given))

    @property
    def again(self) -> str:
        """The command that goes on after an interruption."""
        words = ["clsplat", "capture", *map(str, self.input), "-o", str(self.output)]
        if self.frames is not None:
            words += ["--frames", str(self.frames)]
        if "iterations" in self.given:
            words += ["--iterations", str(self.iterations)]
        if self.device.selector is not None:
            words += ["--device", self.device.selector]
        return shlex.join(words)


def run(verb: CaptureVerb, services: Services) -> int:
    """Carry out the stages of a capture."""
    TrainConfig(iterations=verb.iterations).check()
    result = services.run_capture(
        verb.input,
        verb.output,
        iterations=verb.iterations,
        again=verb.again,
        frames=verb.frames,
        given=verb.given & {"iterations"},
        device=verb.device.selector,
        overwrite=verb.overwrite,
    )
    if verb.json:
        print(json.dumps(result, indent=2))
    return 0
