# SPDX-License-Identifier: Apache-2.0
"""Train a model that is larger than the memory it may have, and say what its steps take.

    tools/stress/run large [--gaussians 20e6] [--degree 3] [--steps 300] [--max-host-mem 4GiB] [--max-device-mem SIZE]
        [--scratch DIR] [--dense] [--near] [--views 60] [--device DEVICE,...] [--batch N] [--whole] [--json]
        [--control SHARE]

The model is a plain of cells, each with a chunk of Gaussians that are made from a seed. Each camera looks at a small
part of the plain. Prints the time of a step, the bytes that a step moves, and the peak of anonymous and shared memory.
Also prints a digest of parameters and moments after the last step, which is the same at every limit. With --batch, a
step has several views, which several devices share, and the bytes of Gaussians that a step moves between devices are
printed too. With --whole, each step runs over the whole model. With --control, density control follows: in a share of
the chunks it clones some Gaussians and removes others. Then its time, its peak, and the bytes that this process reads
and writes for it (Linux) are printed too.
"""

from __future__ import annotations

import hashlib
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
from measuring import plain_parser
from numpy.typing import NDArray
from plain import CELL, SeededArray, settings, timed_steps, write_scene
from typing_extensions import Self

from clsplat.chunks.gathering import SourceList
from clsplat.config.checks import parse_bytes
from clsplat.config.training import TrainConfig
from clsplat.device.selection import open_devices
from clsplat.gaussians import PARAMETER_GROUPS, group_shapes
from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.optimisation.density_rules import FRESH
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.stages.device_gaussians import HostArray, HostGaussians
from clsplat.training.density import RowPlan
from clsplat.training.memory import UNLIMITED, HostMemory
from clsplat.training.step import visible_chunks
from clsplat.training.trainer import Trainer

DIGEST_ROWS = 1 << 18
SECONDS_BETWEEN_LOOKS = 0.02
CHANGED_TOGETHER = 16
"""Consecutive chunks, neighbours in space, that density control changes together."""
REMOVED_EVERY, CLONED_EVERY = 50, 20
"""Density control removes one in this many Gaussians of a chunk, and clones one in this many."""


class MemoryPeak:
    """Largest anonymous and shared memory of a process while it is watched, in bytes.

    process: its number; by default this one.
    """

    def __init__(self, process: int | None = None) -> None:
        self.bytes, self._status = 0, Path(f"/proc/{process or 'self'}/status")
        self._done = Event()
        self._thread = Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._done.wait(SECONDS_BETWEEN_LOOKS):
            with suppress(OSError):  # the process may have ended
                lines = self._status.read_text().splitlines()
                kept = [int(line.split()[1]) for line in lines if line.startswith(("RssAnon", "RssShmem"))]
                self.bytes = max(self.bytes, 1024 * sum(kept))


def large_trainer(scene: Scene, config: TrainConfig, arguments: Any, count: int, scratch: Path) -> Trainer:
    """A trainer whose model is the plain. arguments: the command line's. count: number of Gaussians."""
    limit = parse_bytes(arguments.max_host_mem, "--max-host-mem")
    memory = UNLIMITED if limit is None else HostMemory(limit=limit, scratch=scratch, owner="large")
    on_device = parse_bytes(arguments.max_device_mem, "--max-device-mem")
    device, *further = open_devices(arguments.device, memory_limit=on_device)
    trainer = Trainer(scene, config, device, further=further, memory=memory)
    take_plain(trainer, count)
    return trainer


def take_plain(trainer: Trainer, count: int, only: Sequence[int] | None = None) -> None:
    """Replace a trainer's model by the plain.

    count: number of Gaussians.
    only: numbers of the cells that the model consists of; None for the first cells.
    """
    coefficients, model = (trainer.config.sh_degree + 1) ** 2, trainer.model
    shapes = group_shapes(count, coefficients)
    arrays: Any = {group: SeededArray(group, shape, only) for group, shape in shapes.items()}
    model.free()
    model.plan = trainer.planner.plan(count, trainer.strategy.needs(), trainer.components, trainer.pending.turns)
    model.set(HostGaussians(count, coefficients, arrays, count))
    for component in trainer.components:
        component.rows_moved(HostArray(np.broadcast_to(np.uint32(0), count)))


def changed_rows(count: int, share: float) -> NDArray[np.uint32]:
    """Rows of the plain after density control, which clones some rows and removes others in a share of the chunks."""
    rng, parts, changes = np.random.default_rng(2), [], False
    for number, first in enumerate(range(0, count, CHUNK_ROWS)):
        rows = np.arange(first, min(first + CHUNK_ROWS, count), dtype=np.uint32)
        if number % CHANGED_TOGETHER == 0:
            changes = rng.random() < share
        if changes:
            rows = rows[np.arange(len(rows)) % REMOVED_EVERY > 0]
            fresh = rows[::CLONED_EVERY]
            rows = np.insert(rows, np.arange(0, len(rows), CLONED_EVERY) + 1, fresh | FRESH)
        parts.append(rows)
    return np.concatenate(parts)


def moved_by_process() -> tuple[int, int]:
    """Bytes that this process has read and written so far, by whatever call."""
    lines = Path("/proc/self/io").read_text().splitlines()
    counts = dict(line.split(": ") for line in lines)
    return int(counts["rchar"]), int(counts["wchar"])


def control(trainer: Trainer, share: float) -> str:
    """Run density control in a share of the chunks, and return text with its time, bytes and peak."""
    count = trainer.parameters.count
    rows = changed_rows(count, share)
    plan = RowPlan(listed=SourceList(rows, np.zeros(0, np.uint32)), new_statistics=True)
    begin = time.perf_counter()
    with MemoryPeak() as peak:
        before = moved_by_process()
        trainer.model.rearrange(plan, lambda: None)
        read, written = (after - start for after, start in zip(moved_by_process(), before, strict=True))
    seconds = time.perf_counter() - begin
    return (
        f"density control of {share:.2f} of the chunks, {count:,} to {len(rows):,} Gaussians: {seconds:.1f} s, "
        f"{read / 2**20:,.0f} MiB read, {written / 2**20:,.0f} MiB written, peak {peak.bytes / 2**20:,.0f} MiB"
    )


def digest(trainer: Trainer) -> str:
    """Digest of parameters and moments."""
    hashed, count = hashlib.sha256(), trainer.parameters.count
    for kind, model in trainer.model.kinds().items():
        for group in PARAMETER_GROUPS:
            for start in range(0, count, DIGEST_ROWS):
                hashed.update(f"{kind}/{group}".encode())
                hashed.update(model[group].get_rows(start, min(start + DIGEST_ROWS, count)).tobytes())
    return hashed.hexdigest()[:16]


def main(argv: Sequence[str]) -> int:
    """Train, and print what it took."""
    parser = plain_parser(__doc__)
    parser.add_argument("--gaussians", type=float, default=20e6)
    parser.add_argument("--degree", type=int, default=3)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--views", type=int, default=60)
    parser.add_argument("--max-host-mem")
    parser.add_argument("--max-device-mem")
    parser.add_argument("--scratch", type=Path)
    parser.add_argument("--dense", action="store_true")
    parser.add_argument("--near", action="store_true")
    parser.add_argument("--device")
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--whole", action="store_true")
    parser.add_argument("--control", type=float, metavar="SHARE")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args(argv)
    count = int(arguments.gaussians)
    config = settings(arguments.steps, arguments.degree, dense=arguments.dense)
    config = replace(config, view_order="near" if arguments.near else "random", batch=arguments.batch)
    if arguments.whole:
        vars(visible_chunks)["ORDERED_ROWS"] = count  # no model of this tool has more rows
    with tempfile.TemporaryDirectory() as folder, MemoryPeak() as peak:
        write_scene(Path(folder), -(-count // CHUNK_ROWS), arguments.views, near=arguments.near)
        scene = replace(load_scene(Path(folder), test_every=0), unit=CELL)
        begin = time.perf_counter()
        trainer = large_trainer(scene, config, arguments, count, arguments.scratch or Path(folder) / "scratch")
        made, times = time.perf_counter() - begin, timed_steps(trainer, arguments.steps)
        begin = time.perf_counter()
        trainer.catch_up()
        caught, moved = time.perf_counter() - begin, trainer.model.moved_bytes
        between = 0 if trainer.batch is None else trainer.batch.moved_bytes
        text = digest(trainer)
        controlled = control(trainer, arguments.control) if arguments.control is not None else ""
        text += f", {digest(trainer)} after density control" if controlled else ""
        trainer.close()
    if arguments.json:
        print(json.dumps({**times, "peak": peak.bytes, "digest": text, "between_devices": between / arguments.steps}))
        return 0
    print(
        f"{count:,} Gaussians of degree {arguments.degree}, {'dense' if arguments.dense else 'sparse'} Adam, "
        f"{arguments.steps} steps: {times['median_ms']:.2f} ms a step (median), {times['mean_ms']:.2f} (mean), "
        f"{times['later_ms']:.2f} (mean of the second half), "
        f"{times['processor_ms']:.0f} of all threads (median), "
        f"{moved / arguments.steps / 2**20:.0f} MiB moved a step, {between / arguments.steps / 2**20:.0f} MiB between "
        f"devices, {made:.0f} s to begin, {caught:.0f} s to catch up, "
        f"peak {peak.bytes / 2**20:,.0f} MiB, digest {text}"
    )
    if controlled:
        print(controlled)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
