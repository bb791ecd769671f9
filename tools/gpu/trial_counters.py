#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Read hardware counters of a step's kernels with NVIDIA's Nsight Compute (ncu), for trial.py.

    trial_counters.py COPIES DUMPS      launches the kernels in a process that ncu observes

ncu does not support OpenCL. So a CUDA copy of each kernel runs, with the arguments of a launch of the step. The copy is
PTX that clang compiles from the same text (`write_twins`, run beforehand on a machine with clang). `gpu_static.py`
counts instructions in this code too. It differs from the code of NVIDIA's OpenCL compiler. This tool needs CuPy, and
has not run on a GPU yet.
"""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

TWINS = ("blend", "blend_grad", "loss_ssim", "loss_grad")
"""Kernels that have only numbers and arrays in global memory as arguments, so that CUDA can launch them."""
METRICS = {
    "smsp__issue_active.avg.pct_of_peak_sustained_active": "issue slots used, %",
    "sm__warps_active.avg.pct_of_peak_sustained_active": "warps at a time, %",
    "smsp__inst_executed.sum": "instructions",
    "smsp__average_warps_issue_stalled_long_scoreboard_per_issue_active.ratio": "stalled by global memory",
    "smsp__average_warps_issue_stalled_short_scoreboard_per_issue_active.ratio": "stalled by local memory",
    "smsp__average_warps_issue_stalled_barrier_per_issue_active.ratio": "stalled by barriers",
    "l1tex__data_pipe_lsu_wavefronts_mem_shared.sum": "wavefronts of local memory",
    "lts__t_bytes.sum": "bytes of L2",
    "dram__bytes.sum": "bytes of memory",
    "gpu__time_duration.sum": "time",
}
"""Descriptions of the metrics, by ncu's names."""


def measure(subject: Any, device: Any, twins: Path, seconds: float) -> list[dict[str, Any]]:
    """Counters of each kernel that has a CUDA copy in the folder `twins`. Raises OSError, RuntimeError, TimeoutExpired.

    seconds: time limit.
    """
    there = [kernel for kernel in TWINS if (twins / f"{kernel}.ptx").is_file()]
    if not there:
        raise FileNotFoundError(f"{twins}: has no kernel, expected a .ptx file of {' or '.join(TWINS)}")
    with tempfile.TemporaryDirectory(prefix="clsplat-trial-") as folder:
        dump(subject, device, there, Path(folder))
        ncu = ["ncu", "--csv", "--page", "raw", "--clock-control", "none", "--metrics", ",".join(METRICS)]
        child = [sys.executable, "-X", "faulthandler", str(Path(__file__)), str(twins), folder]
        done = subprocess.run([*ncu, *child], capture_output=True, text=True, timeout=seconds, check=False)
    if done.returncode:
        print(done.stdout, done.stderr, sep="\n", file=sys.stderr)
        raise RuntimeError(f"ncu: {done.stderr or done.stdout}")
    return counters_of(done.stdout)


def dump(subject: Any, device: Any, kernels: Sequence[str], folder: Path) -> None:
    """Write the arguments of the first launch of each kernel in a step by capacity."""
    import pyopencl as cl
    from trial_variants import TrialScene

    from clsplat.device.command_buffer import typed

    enqueue, dumped = device.enqueue, set()

    def first(kernel: Any, size: Any, local: Any, values: Sequence[Any], *, wait: bool = False) -> Any:
        if kernel.name in kernels and kernel.name not in dumped:
            dumped.add(kernel.name)
            arrays, order = {}, []
            for index, value in enumerate(values):
                if isinstance(value, cl.Buffer):
                    held = arrays[f"array{index}"] = np.empty(value.size, np.uint8)
                    cl.enqueue_copy(device.queue, held, value)
                    order.append(f"array{index}")
                else:
                    arrays[f"number{index}"] = np.array(typed(value))
                    order.append(f"number{index}")
            launch = {"size": size, "local": local, "order": order}
            np.savez(folder / f"{kernel.name}.npz", allow_pickle=False, launch=json.dumps(launch), **arrays)
        return enqueue(kernel, size, local, values, wait=wait)

    device.enqueue = first  # before there is a trainer, as it makes copies of the device
    try:
        trainer = TrialScene(subject, device).trainer
        # This step counts its pairs. The CUDA copies are of steps by capacity, whose kernels have other arguments.
        trainer.train_step()
        dumped.clear()
        trainer.train_step()
    finally:
        del device.enqueue


def counters_of(text: str) -> list[dict[str, Any]]:
    """Rows from ncu's CSV: a kernel, and its counters with units, by description."""
    lines = [line for line in text.splitlines() if line.startswith('"')]
    header, units, *rows = csv.reader(lines)
    names = {place: METRICS[name] for place, name in enumerate(header) if name in METRICS}
    kernel = header.index("Kernel Name")
    return [
        {"kernel": row[kernel], "counted": {name: f"{row[k]} {units[k]}".strip() for k, name in names.items()}}
        for row in rows
    ]


def write_twins(folder: Path, target: str) -> list[str]:
    """Write CUDA copies, as PTX, of the kernels TWINS of the usual step. Returns their names. Raises ClsplatError."""
    from gpu_compilers import ask_package, assembled, build_builtins
    from gpu_static import FRAMES, sources_of

    frames = json.loads(FRAMES.read_text())["frames"]
    launches = ask_package("1x64", [frame for frame in frames if frame["name"] == "made up, 1 M"])[0]
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    with tempfile.TemporaryDirectory(prefix="clsplat-gpu-") as scratch:
        builtins = build_builtins(target, Path(scratch))
        for source, kernels in sources_of(launches).items():
            if wanted := [kernel for kernel in kernels if kernel in TWINS]:
                text = assembled(source, target, builtins, Path(scratch)).read_text()
                for kernel in wanted:
                    (folder / f"{kernel}.ptx").write_text(text)
                written += wanted
    return written


def arguments_of(path: Path) -> tuple[Mapping[str, Any], Iterator[np.ndarray]]:
    """The launch that `dump` has written, and its arguments in order: arrays of bytes, and numbers as arrays without
    axes."""
    loaded = np.load(path)
    launch = json.loads(str(loaded["launch"]))
    return launch, (loaded[name] for name in launch["order"])


def main(arguments: Sequence[str]) -> int:
    """Launch each CUDA copy once."""
    import cupy

    twins, dumps = map(Path, arguments)
    for path in sorted(dumps.glob("*.npz")):
        launch, values = arguments_of(path)
        held = [cupy.asarray(value) if value.ndim else value[()] for value in values]
        groups = [size // local for size, local in zip(launch["size"], launch["local"], strict=True)]
        kernel = cupy.RawModule(path=str(twins / f"{path.stem}.ptx")).get_function(path.stem)
        kernel(tuple(groups), tuple(launch["local"]), tuple(held))
        cupy.cuda.runtime.deviceSynchronize()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
