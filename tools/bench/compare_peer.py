#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Compare a training step with OpenSplat 1.2.0 (CPU), which was measured on another machine with the same scenes.

    python tools/bench/compare_peer.py fox banana sceaux_castle --limit './limit 20000' [--device DEVICE] [--json]
    python tools/bench/compare_peer.py fox --limit-gpairs 3.55

The arguments are the scenes' folders (docs/quality.md names their sources), with the peer's picture sizes and starting
points. The step is the trainer's own at the full size (`--warmup ''`), with pictures decoded beforehand as in the peer.
Its time is the median of steps 3 to 30: wall time from an idle device to an idle device.

The peer's seconds are scaled to this machine by a limit of both machines: the (Gaussian, pixel) pairs per second that
blending's arithmetic allows if everything is in registers. The limit was 5.09 Gpairs/s on the peer's machine, with two
cores and vectors of 16 lanes. --limit is a program, with its arguments, that prints `... N Gpairs/s` for this machine.
It runs after every second step, and its median is used, so that other load slows it like the steps. Short runs suffice
(20000 repetitions of limit.c). Build the program for the vectors that the machine has: with wider ones it is too slow,
and the peer would look slower than it is. For the same reason clsplat's own kernel for this limit is measured too, and
the higher limit is used. (On AVX-512, with vectors of 16, the kernel does a quarter more than limit.c, as it needs
fewer operations per pair; its speed on the peer's machine is unknown.) --limit-gpairs replaces the program by a known
limit.
"""

from __future__ import annotations

import math
import re
import shlex
import statistics
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from measuring import Result, machine, plain_parser, require, show, tool

from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.errors import InputError
from clsplat.progress import aligned
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.stages.peak import measure_limits
from clsplat.training.trainer import Trainer


@dataclass(frozen=True)
class Peer:
    """The peer's pixels and starting Gaussians, and its median seconds per step."""

    width: int
    height: int
    gaussians: int
    seconds: float


PEER = "OpenSplat 1.2.0"
PEERS = {
    "fox": Peer(449, 800, 13_560, 0.335),
    "banana": Peer(800, 532, 7_426, 0.328),
    "sceaux_castle": Peer(800, 590, 8_378, 0.462),
}
"""Medians of steps 3 to 30 on a quiet machine, with OMP_WAIT_POLICY=passive, which is faster than without."""
PEER_GPAIRS = 5.09
"""The limit of the peer's machine, in 10^9 pairs per second."""
FIRST, LAST = 3, 30


def open_scene(folder: Path) -> tuple[Scene, Peer]:
    """The scene that the peer trained, and the peer's figures. Raises InputError if pictures or points differ."""
    scene = load_scene(folder)
    peer = PEERS.get(scene.name)
    if peer is None:
        raise InputError(f"{folder}: the peer has not been measured on it, expected one of {', '.join(PEERS)}")
    for view in scene.views:
        found = (view.camera.width, view.camera.height)
        if found != (peer.width, peer.height):
            raise InputError(f"{view.path}: is {found[0]}x{found[1]}, the peer had {peer.width}x{peer.height}")
    if len(scene.points) != peer.gaussians:
        raise InputError(f"{folder}: has {len(scene.points)} points, the peer started from {peer.gaussians}")
    return scene, peer


def step_and_limit(scene: Scene, device: Device, program: str | None) -> tuple[float, float | None]:
    """Median time of a training step in milliseconds, and the median limit in Gpairs/s, None without a program.

    The program prints the limit between steps. Raises InputError.
    """
    trainer = Trainer(scene, TrainConfig(warmup=()), device)
    for index in range(len(trainer.views)):
        trainer.photographs.load(index, 1)
    times, limits = [], []
    for step in range(LAST):
        times.append(device.timed(trainer.train_step)[1])
        if program is not None and step % 2:
            limits.append(limit_of(program))
    return statistics.median(times[FIRST - 1 :]), statistics.median(limits) if limits else None


def limit_of(program: str) -> float:
    """The limit of this machine in Gpairs/s, as printed by the program. Raises InputError."""
    try:
        done = subprocess.run(shlex.split(program), capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError, ValueError, IndexError) as error:
        raise InputError(f"--limit {program}: cannot be run ({error})") from None
    match = re.search(r"([\d.]+) Gpairs/s", done.stdout)
    require(match is not None, f"--limit {program}: printed {done.stdout.strip()!r}, expected N Gpairs/s in it")
    assert match is not None
    return float(match[1])


def measure(folder: Path, device: Device, program: str | None, known: float | None) -> Result:
    """A row of the table. Times are in seconds except for `ms`; limits are in Gpairs/s.

    program: prints the limit. known: the limit, if no program is given.
    """
    scene, peer = open_scene(folder)
    ms, printed = step_and_limit(scene, device, program)
    limits: dict[str, float] = {}
    if known is not None:
        limits["given"] = known
    elif printed is not None:
        limits["program"] = printed
        limits["kernel"] = 1e-9 * measure_limits(device, copy_bytes=2**20, widened=False).pairs_per_second
    limit = max(limits.values())
    scaled = peer.seconds * PEER_GPAIRS / limit
    return {
        "scene": scene.name,
        "width": peer.width,
        "height": peer.height,
        "gaussians": peer.gaussians,
        "ms": ms,
        "limits": limits,
        "limit": limit,
        "peer_seconds": peer.seconds,
        "peer_seconds_scaled": scaled,
        "ratio": 1e3 * scaled / ms,
    }


def table(result: Result) -> list[str]:
    """Text table with a line for each scene."""
    header = ("scene", "image", "Gaussians", "ms", "peer, s", "limit, Gpairs/s", "peer scaled, s", "scaled / ours")
    rows: list[tuple[str, ...]] = [header]
    for row in result["rows"]:
        size, limit = f"{row['width']}x{row['height']}", f"{row['limit']:.2f}"
        times = (f"{row['ms']:.1f}", f"{row['peer_seconds']:.3f}", limit, f"{row['peer_seconds_scaled']:.3f}")
        rows.append((row["scene"], size, f"{row['gaussians']:,}", *times, f"{row['ratio']:.1f}"))
    note = f"peer: {PEER}, measured where the limit was {PEER_GPAIRS} Gpairs/s"
    others = [
        f"{row['scene']}: {', '.join(f'{name} {value:.2f}' for name, value in row['limits'].items())}"
        for row in result["rows"]
        if len(row["limits"]) > 1
    ]
    return [*aligned(rows), "", note, *([f"limits, the largest counts: {'; '.join(others)}"] if others else [])]


@tool("compare_peer")
def main(arguments: Sequence[str]) -> int:
    """Run the measurement and print its results."""
    parser = plain_parser(__doc__)
    parser.add_argument("scenes", metavar="SCENE", nargs="+", type=Path)
    limit = parser.add_mutually_exclusive_group(required=True)
    limit.add_argument("--limit", metavar="PROGRAM")
    limit.add_argument("--limit-gpairs", metavar="N", type=float)
    parser.add_argument("--device")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    known: float | None = options.limit_gpairs
    if known is not None:
        require(0 < known < math.inf, f"--limit-gpairs {known}: expected more than 0")
    for folder in options.scenes:
        open_scene(folder)
    if options.limit is not None:
        limit_of(options.limit)  # reports a program that does not run before any measurement
    device = open_device(options.device)
    rows = []
    for folder in options.scenes:
        print(f"{folder}: {LAST} steps", file=sys.stderr, flush=True)
        rows.append(measure(folder, device, options.limit, known))
    result = {**machine(device, LAST - FIRST + 1), "peer": PEER, "peer_limit": PEER_GPAIRS, "rows": rows}
    show(result, table(result), as_json=options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
