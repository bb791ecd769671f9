# SPDX-License-Identifier: Apache-2.0
"""`clsplat demo`: the whole pipeline on a synthetic scene, or a town as an example of a large scene."""

from __future__ import annotations

import json
import sys
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Annotated, ClassVar

from tyro.conf import arg

from clsplat.cli.flags import Groups
from clsplat.cli.options import DeviceChoice, Flag, Output, Verb
from clsplat.cli.session import Services
from clsplat.config.cli_defaults import DEMO_ITERATIONS
from clsplat.config.training import TrainConfig
from clsplat.demo.town.settings import TownConfig, TownRig, three_numbers, two_numbers
from clsplat.errors import InputError
from clsplat.progress import StageProgress


@dataclass(frozen=True)
class DemoVerb(Verb):
    """Make photographs of a small scene, recover their cameras, train, evaluate and render a turntable.

    With --town, write a large example scene instead: a town with any number of photographs, as a COLMAP scene.
    """

    groups: ClassVar[Groups] = (
        ("A town", ("town", "town-*", "seed", "overwrite")),
        ("Output and device", ("output", "iterations", "device", "json")),
    )

    output: Output
    """Folder for all results: a new folder, or the folder of an earlier demo, whose content is replaced. For a town: a
    new folder."""
    iterations: int = DEMO_ITERATIONS
    """Training steps. A few hundred are enough to test the pipeline, but the model then has less detail."""
    device: Annotated[DeviceChoice, arg(name="")] = field(default_factory=DeviceChoice)
    json: Flag = False
    """Print the evaluation as JSON on standard output; for a town its settings and counts."""
    town: Annotated[str | None, arg(metavar="NxM")] = None
    """Write a town of NxM city blocks of 60 metres, without training. A larger town has the photographs of a smaller
    one, byte for byte."""
    town_photos: Annotated[int, arg(metavar="COUNT")] = TownConfig.photos
    """Photographs of each block: three in ten look straight down, four in ten at a slant, three in ten from streets."""
    town_size: Annotated[str, arg(metavar="WxH")] = f"{TownConfig.width}x{TownConfig.height}"
    """Size of the photographs in pixels."""
    town_rig: TownRig = TownConfig.rig
    """Cameras in the streets: perspective, fisheye (OPENCV_FISHEYE, 180 degrees across the picture) or panorama
    (EQUIRECTANGULAR, W x W/2 pixels)."""
    town_exposure: Annotated[float, arg(metavar="STOPS")] = TownConfig.exposure
    """Largest change of exposure, in stops. The exposure differs from flight to flight, and drifts along a flight."""
    town_cars: Annotated[int, arg(metavar="COUNT")] = TownConfig.cars
    """Moving cars in each block. Each photograph shows them in other places, and masks leave them out."""
    town_origin: Annotated[str, arg(metavar="X,Y,Z")] = "0,0,0"
    """World coordinates of the town's corner in metres, such as 500000,4650000,0, as in a survey."""
    town_pose_noise: Annotated[float, arg(metavar="METRES")] = TownConfig.pose_noise
    """Standard deviation of errors in the written camera positions, along each axis. The exact cameras are written to
    the sub-folder exact."""
    seed: int = TownConfig.seed
    """Seed of the town, its cameras and all noise."""
    overwrite: Flag = False
    """Replace an earlier town in the output folder."""

    def completed(self, given: Collection[str]) -> DemoVerb:
        """Return the arguments. Raises InputError for a flag without effect, such as --iterations with --town."""
        others = ("iterations", "device") if self.town is not None else ("town_", "seed", "overwrite")
        if wrong := sorted(name for name in given if name.startswith(others)):
            flag = wrong[0].replace("_", "-")
            raise InputError(
                f"--{flag}: has no effect with --town, which trains nothing; omit --town, or give --{flag} to clsplat "
                "train"
                if self.town is not None
                else f"--{flag}: has an effect only with --town, expected --town too, such as --town 2x2"
            )
        return self


def run(verb: DemoVerb, services: Services) -> int:
    """Run the device's self-test, then the demo. If a town is requested, only write the town, without a device."""
    if verb.town is not None:
        return _write_town(verb, services)
    TrainConfig(iterations=verb.iterations).check()
    verb.device.trusted(services)
    result = services.run_demo(verb.output, device=verb.device.selector, iterations=verb.iterations)
    if verb.json:
        print(json.dumps(result, indent=2))
    return 0


def _write_town(verb: DemoVerb, services: Services) -> int:
    assert verb.town is not None
    columns, rows = two_numbers("town", verb.town, "3x2")
    width, height = two_numbers("town-size", verb.town_size, "640x400")
    config = TownConfig(
        columns=columns,
        rows=rows,
        photos=verb.town_photos,
        width=width,
        height=height,
        seed=verb.seed,
        rig=verb.town_rig,
        exposure=verb.town_exposure,
        cars=verb.town_cars,
        origin=three_numbers("town-origin", verb.town_origin),
        pose_noise=verb.town_pose_noise,
    )
    config.check()
    record = services.write_town(verb.output, config, overwrite=verb.overwrite, progress=StageProgress())
    if verb.json:
        print(json.dumps(record, indent=2))
    more = {
        " --lenses native": config.is_fisheye,
        " --masks ignore": bool(config.cars),
        " --appearance exposure": bool(config.exposure),
        " --refine-poses": bool(config.pose_noise),
    }
    flags = " --sky 3000" + "".join(flag for flag, is_useful in more.items() if is_useful)
    exact = f"; exact cameras in {verb.output / 'exact'}" if config.pose_noise else ""
    print(
        f"town of {columns}x{rows} blocks, {record['photographs']:,} photographs and {record['points']:,} points in "
        f"{verb.output}{exact}; next: clsplat train {verb.output} -o RUN{flags}",
        file=sys.stderr,
    )
    return 0
