#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Time deep frames: the kernels, the writing of the same samples by OpenEXR, and everything together.

    python tools/bench/deep_times.py [MODEL CAMERAS] [--size 1920x1080] [--bins 16] [--samples 1] [--repeats 5]
        [--device NAME]

Without MODEL the scene is a synthetic one of 200,000 Gaussians. The frame is the first of CAMERAS. It is rendered once
beforehand, so that kernels are built. Prints medians in seconds, the number of samples, and the peak of the process's
memory while it renders. For the writing time, the samples are read back and written with OpenImageIO, with as many
threads as for the frame. On a machine with other load, CPU time is more reliable.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import OpenImageIO as oiio

from clsplat.bench.workload import synthetic
from clsplat.camera import Camera
from clsplat.cli.bench import parse_size
from clsplat.config.pictures import ColourConfig, Encoding, PictureConfig, SamplingConfig
from clsplat.device.selection import open_device
from clsplat.frame.deep_exr import write_deep
from clsplat.frame.pipeline import FramePipeline, FrameRequest
from clsplat.gaussians import Gaussians
from clsplat.images.frame_files import FrameFileHeader, deep_spec
from clsplat.rendering.renderer import Renderer
from clsplat.sequence.frame_renderer import TRANSFER_COMMANDS
from clsplat.shots.read import read_shot


def main(arguments: list[str]) -> int:
    """Render, and print the medians."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, nargs="?")
    parser.add_argument("cameras", type=Path, nargs="?")
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--bins", type=int, default=16)
    parser.add_argument("--samples", type=int, default=1, help="of a lens, merged into one picture")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--device")
    options = parser.parse_args(arguments)
    size = parse_size(options.size)
    assert size is not None
    if options.model is None:
        subject = synthetic(200_000, *size)
        gaussians, camera = subject.gaussians, subject.camera
    else:
        gaussians, camera = Gaussians.load(options.model), read_shot(options.cameras).frames[0].camera
    camera, bins = camera.reshaped(*size), options.bins
    renderer, encoding = Renderer(open_device(options.device)), Encoding(compression="zips")
    lens = SamplingConfig(options.samples, aperture=0.01, focus=1.0) if options.samples > 1 else SamplingConfig()
    config = PictureConfig(ColourConfig(colorspace="lin_rec709"), sampling=lens)

    def made(path: Path, renderer: Renderer, camera: Camera) -> None:
        draw, convert, rows = FramePipeline(renderer, gaussians, config).draw_deep(bins, FrameRequest(lambda _: camera))
        write_deep(path, draw, camera, rows(camera), bins, encoding, None, convert)

    with TemporaryDirectory() as folder:
        path = Path(folder) / "deep.exr"
        made(path, renderer, camera.resized(64, 36))
        totals, kernels, used = [], [], time.process_time()
        for _ in range(options.repeats):
            start = time.monotonic()
            made(path, renderer, camera)
            totals.append(time.monotonic() - start)
        used = (time.process_time() - used) / options.repeats
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        device = open_device(options.device, profile=True)  # only now, as profiling events take memory
        renderer = Renderer(device)
        for _ in range(options.repeats):
            with device.recorder.recording(wait=False) as stages:
                made(path, renderer, camera)
            times = [item for record in stages.values() for item in record.kernels.items()]
            kernels.append(sum(taken for name, taken in times if name not in TRANSFER_COMMANDS) / 1000)
        again, spec = Path(folder) / "again.exr", deep_spec(*size, encoding, FrameFileHeader())
        pairs = [_written(path, again, spec) for _ in range(options.repeats)]
        writes, of_writer = ([pair[which] for pair in pairs] for which in (0, 1))
        same = path.read_bytes() == again.read_bytes()
        image = oiio.ImageBuf(str(path))
        data = image.deepdata()
        samples = sum(data.samples(pixel) for pixel in range(data.pixels))
    total, kernel, write = map(statistics.median, (totals, kernels, writes))
    print(
        f"{camera.width}x{camera.height}, {options.bins} slices, {samples:,} samples: {total:.2f} s, kernels "
        f"{kernel:.2f} s, OpenEXR's writer {write:.2f} s ({'the same bytes' if same else 'OTHER BYTES'}); "
        f"{total / kernel:.2f} times the kernels, {total / (kernel + write):.2f} times kernels and writer; CPU time "
        f"{used:.2f} s, the writer's {statistics.median(of_writer):.2f} s; peak memory {most / 2**20:.0f} MiB"
    )
    return int(not same)


def _written(path: Path, again: Path, spec: Any) -> tuple[float, float]:
    """Write the samples of the deep EXR `path` to the file `again`. Returns the wall and CPU seconds of writing."""
    image = oiio.ImageBuf(str(path))
    data = image.deepdata()
    start, used = time.monotonic(), time.process_time()
    target = oiio.ImageOutput.create(str(again))
    assert target is not None, oiio.geterror()
    assert target.open(str(again), spec), target.geterror()
    assert target.write_deep_image(data), target.geterror()
    target.close()
    return time.monotonic() - start, time.process_time() - used


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
