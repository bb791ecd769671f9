# SPDX-License-Identifier: Apache-2.0
"""`clsplat bench`: times of the stages of a frame and of a training step on a device."""

from __future__ import annotations

import json
import sys
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from clsplat.cli.options import DeviceOptions, Flag, Verb, with_given
from clsplat.cli.session import Services
from clsplat.config.checks import check_rules, parse_bytes
from clsplat.config.presets import RASTERIZER_PRESETS, Preset
from clsplat.config.rasterizer import BenchSwitches
from clsplat.errors import InputError


@dataclass(frozen=True)
class BenchVerb(Verb):
    """Measure each stage of a frame and of a training step, and the limits of the device in the same run.

    docs/performance.md explains the figures.
    """

    source: Annotated[Positional[Path | None], arg(metavar="SCENE|RUN|MODEL")] = None
    """A scene, measured as at the start of training; a run; or a model file. If not given: a synthetic scene."""
    gaussians: int = 200_000
    """Number of Gaussians of the synthetic scene."""
    size: Annotated[str | None, arg(metavar="WIDTHxHEIGHT")] = None
    """Size of the frame in pixels. If not given: the camera's size, or 1024x768 for the synthetic scene."""
    repeat: int = 5
    """Number of times that each frame and each step is measured. The printed times are medians."""
    preset: Preset = "default"
    """Bundle of rasterizer settings: exact and default approximate nothing, fast approximates a little. A --rasterizer
    flag overrides it."""
    plot: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also measure every setting of the rasterizer, and draw two plots (.svg or .png). If FILE is NAME.svg,
    the plots are NAME-switches.svg and NAME-error.svg. The first shows the time that each setting saves without
    changing pictures; the second shows the time and error of each approximate setting."""
    overwrite: Flag = False
    """Replace existing plots."""
    device: Annotated[DeviceOptions, arg(name="")] = field(default_factory=DeviceOptions)
    json: Flag = False
    """Print the result as JSON."""
    rasterizer: BenchSwitches = field(default_factory=BenchSwitches)

    def completed(self, given: Collection[str]) -> BenchVerb:
        """Return the arguments with the rasterizer's settings of --preset, except for the flags that are `given`."""
        switches = RASTERIZER_PRESETS[self.preset].switches()
        return replace(self, rasterizer=with_given(switches, self.rasterizer, given, "rasterizer."))


def run(verb: BenchVerb, services: Services) -> int:
    """Measure and print the times of the stages of a frame and of a training step. Checks the command line first."""
    from clsplat.bench import settings as tradeoff
    from clsplat.bench import stages as bench_stages
    from clsplat.bench import workload as bench_subject
    from clsplat.bench.plots import check_plot, plot_files, plot_settings
    from clsplat.files.atomic import check_new
    from clsplat.progress import StageProgress

    size, limit = parse_size(verb.size), parse_bytes(verb.device.max_device_mem)
    check_rules(verb, "--", ((("gaussians", "repeat"), lambda value: value >= 1, "at least 1"),))
    verb.rasterizer.check()
    if verb.plot is not None:
        check_plot(verb.plot)
        for file in plot_files(verb.plot):
            check_new(file, overwrite=verb.overwrite)
    if verb.source is not None and not verb.source.exists():
        raise InputError(f"{verb.source}: no such file or folder, expected a scene, a run or a model file")
    progress = StageProgress()
    device = services.require(services.open_device(verb.device.selector, limit, profile=True))
    most = int(device.cl_device.global_mem_size) // bench_stages.TRAINING_BYTES_PER_GAUSSIAN
    if verb.source is None and verb.gaussians > most:
        raise InputError(f"--gaussians {verb.gaussians}: expected at most {most}, the most that fit on {device.name}")
    if verb.source is None:
        subject = bench_subject.synthetic(verb.gaussians, *(size or (1024, 768)))
    else:
        subject = bench_subject.load_subject(verb.source, size, progress)
    result = bench_stages.bench(subject, device, verb.rasterizer, repeat=verb.repeat, progress=progress)
    if verb.plot is not None:
        result["settings"] = tradeoff.compare(subject, device, repeat=verb.repeat, progress=progress)
        size_text = f"{result['width']}x{result['height']}, {result['gaussians']:,} Gaussians"
        title = f"{subject.name}, {size_text}\n{device.name}, {device.driver.split('  ')[0]}"
        for file in plot_settings(verb.plot, result["settings"], title):
            print(f"plot in {file}", file=sys.stderr)
    if verb.json:
        print(json.dumps(result, indent=2))
        return 0
    print(bench_stages.table(result))
    if "settings" in result:
        print("\n" + tradeoff.settings_table(result["settings"]))
    return 0


def parse_size(text: str | None) -> tuple[int, int] | None:
    """Parse WIDTHxHEIGHT to (width, height). None stays None. Raises InputError."""
    if text is None:
        return None
    words = text.split("x")
    if len(words) != 2 or not all(word.isdecimal() and int(word) > 0 for word in words):
        raise InputError(f"--size {text}: expected a width and a height in pixels such as 1024x768")
    return int(words[0]), int(words[1])
