#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Time other programs' frame and training step on the same Gaussians and camera.

    trial_peers.py PEER SUBJECT.npz REPEAT     prints the times as a line of JSON; for trial.py

gsplat: https://github.com/nerfstudio-project/gsplat, with torch's fused Adam. Faster-GS: FasterGSFusedCudaBackend of
https://github.com/nerficg-project/faster-gaussian-splatting, which has Adam in its backward pass. The loss of both is
L1 + D-SSIM by the package fused_ssim, or L1 alone if that cannot be imported. Learning rates are 0 in gsplat; Faster-GS
has constant ones. Both run on CUDA alone. This tool has run them on an H200.
"""

from __future__ import annotations

import ctypes
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

PEERS = {"gsplat": "gsplat", "Faster-GS": "FasterGSFusedCudaBackend", "fused-ssim": "fused_ssim"}
"""Names of packages and source folders, by program. A folder may have the program's or the package's name."""
TIMED = ("gsplat", "Faster-GS")
DEVICE = "cuda"
WARM_UP = 5
JOBS = 8
"""Number of compilers that run at a time, so that cores are left for the host's part of the measurements."""
WEIGHT = 0.2
"""Weight of D-SSIM in the loss, as in clsplat."""
Step = Callable[[], object]


def last_line(text: str, otherwise: str) -> str:
    """The last line of a text that is not blank; `otherwise` if there is none."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else otherwise


def no_cuda() -> str:
    """The reason why no program for CUDA can run here, or empty."""
    name = "nvcuda.dll" if os.name == "nt" else "libcuda.so.1"
    try:
        ctypes.CDLL(name)
    except OSError:
        return f"there is no CUDA: {name} is not found"
    return ""


class Builds:
    """Builds of peers' sources in the background.

    folder: contains a folder of sources for each peer; None builds nothing.
    into: folder for the built packages.
    """

    def __init__(self, folder: Path | None, into: Path) -> None:
        self.into, self.failed = into, dict[str, str]()
        self._running: list[tuple[str, subprocess.Popen[str]]] = []
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-build-isolation"]
        for peer, package in PEERS.items() if folder is not None else ():
            sources = [path for name in (peer, package) if (path := Path(folder or "") / name).is_dir()]
            if not sources:
                self.failed[peer] = f"no folder {peer} in {folder}"
                continue
            command = [*pip, "--target", str(into), str(sources[0])]
            environment = os.environ | {"MAX_JOBS": str(JOBS)}
            process = subprocess.Popen(
                command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=environment
            )
            self._running.append((peer, process))

    def finish(self, seconds: float) -> None:
        """Wait for the builds that are still running, and note which failed."""
        end = time.monotonic() + seconds
        for peer, process in self._running:
            try:
                _, told = process.communicate(timeout=max(end - time.monotonic(), 0.1))
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()
                self.failed[peer] = "its build was not done in time"
                continue
            if process.returncode:
                self.failed[peer] = f"its build failed: {last_line(told, f'status {process.returncode}')}"
        self._running.clear()


def save(subject: Any, photograph: np.ndarray, path: Path) -> None:
    """Write a subject of `clsplat.bench.workload`, and the photograph for the loss, for the child process."""
    model, camera = subject.gaussians, subject.camera
    arrays = {name: getattr(model, name) for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh")}
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = camera.rotation, camera.translation
    lens = np.array([camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy])
    np.savez(path, **arrays, view=view, lens=lens, photograph=photograph)


def measure(peer: str, subject: Path, repeat: int, path: Path, seconds: float) -> dict[str, Any] | str:
    """Times of a peer on a subject, in a child process, or the reason why there are none.

    subject: file that `save` has written.
    path: folder with the built packages.
    seconds: time limit.
    """
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, (str(path), os.environ.get("PYTHONPATH"))))}
    command = [sys.executable, str(Path(__file__)), peer, str(subject), str(repeat)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        return f"not done within {seconds:.0f} s"
    if done.returncode:
        return last_line(done.stderr, f"status {done.returncode}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def steps_of(peer: str, data: Mapping[str, np.ndarray], torch: Any) -> tuple[Step, Step, str]:
    """Functions for a peer's frame and training step, and a description of its loss. torch: the module."""
    there = {name: torch.tensor(data[name], dtype=torch.float32, device=DEVICE) for name in data}
    photograph = there["photograph"].permute(2, 0, 1)[None].contiguous()
    try:
        from fused_ssim import fused_ssim
    except ImportError:
        fused_ssim = None

    def loss(image: Any) -> Any:
        absolute = (image - photograph).abs().mean()
        if fused_ssim is None:
            return absolute
        return (1 - WEIGHT) * absolute + WEIGHT * (1 - fused_ssim(image, photograph))

    told = "L1" if fused_ssim is None else "L1 + D-SSIM (fused_ssim)"
    frame, step = (gsplat_steps if peer == "gsplat" else faster_gs_steps)(there, data["lens"], loss, torch)
    return frame, step, told


def gsplat_steps(
    there: Mapping[str, Any], lens: np.ndarray, loss: Callable[[Any], Any], torch: Any
) -> tuple[Step, Step]:
    """Functions for gsplat's frame and training step."""
    from gsplat import rasterization

    names = ("means", "quaternions", "log_scales", "opacity_logits")
    parameters, rest = {name: there[name].requires_grad_() for name in names}, there["sh"].shape[1] - 1
    parameters["sh0"], parameters["shN"] = (part.clone().requires_grad_() for part in there["sh"].split([1, rest], 1))
    optimiser = torch.optim.Adam(list(parameters.values()), lr=0.0, fused=True)
    width, height, fx, fy, cx, cy = map(float, lens)
    matrix = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], device=DEVICE)[None]
    degree = int(there["sh"].shape[1] ** 0.5) - 1

    def image() -> Any:
        colours = torch.cat([parameters["sh0"], parameters["shN"]], 1)
        shapes = (parameters["means"], parameters["quaternions"], parameters["log_scales"].exp())
        shown = (parameters["opacity_logits"].sigmoid(), colours, there["view"][None], matrix, int(width), int(height))
        return rasterization(*shapes, *shown, sh_degree=degree, packed=False)[0].permute(0, 3, 1, 2)

    def frame() -> None:
        with torch.no_grad():
            image()

    def step() -> None:
        optimiser.zero_grad(set_to_none=True)
        loss(image()).backward()
        optimiser.step()

    return frame, step


def faster_gs_steps(
    there: Mapping[str, Any], lens: np.ndarray, loss: Callable[[Any], Any], torch: Any
) -> tuple[Step, Step]:
    """Functions for Faster-GS's frame and training step. Its backward pass takes Adam's step."""
    from FasterGSFusedCudaBackend.torch_bindings.rasterization import RasterizerSettings, diff_rasterize

    model = {
        "means": there["means"],
        "scales": there["log_scales"],
        "rotations": there["quaternions"],
        "opacities": there["opacity_logits"][:, None].contiguous(),
        "sh_coefficients_0": there["sh"][:, :1].contiguous(),
        "sh_coefficients_rest": there["sh"][:, 1:].contiguous(),
    }
    moments = {f"moments_{name}": torch.zeros(*values.shape, 2, device=DEVICE) for name, values in model.items()}
    width, height, *rest = map(float, lens)
    view, number = there["view"], 0
    position = -view[:3, :3].T @ view[:3, 3]
    background, dummy = torch.zeros(3, device=DEVICE), torch.zeros(1, device=DEVICE, requires_grad=True)

    def image(**more: Any) -> Any:
        size = (there["sh"].shape[1], int(width), int(height))
        settings = RasterizerSettings(view, position, background, *size, *rest, 0.01, 1e6, 0.0, number)
        return diff_rasterize(
            autograd_dummy=dummy, densification_info=torch.empty(0), rasterizer_settings=settings, **model, **more
        )[0][None]

    def frame() -> None:
        with torch.no_grad():
            image()

    def step() -> None:
        nonlocal number
        number += 1
        loss(image(**moments)).backward()

    return frame, step


def main(arguments: Sequence[str]) -> int:
    """Time a peer, and print the milliseconds."""
    peer, subject, repeat = arguments
    import torch

    if not torch.cuda.is_available():
        print(f"PyTorch {torch.__version__} sees no CUDA device", file=sys.stderr)
        return 1
    with np.load(subject) as loaded:
        data = {name: loaded[name] for name in loaded.files}
    frame, step, told = steps_of(peer, data, torch)
    found: dict[str, Any] = {"loss": told, "device": torch.cuda.get_device_name(), "torch": torch.__version__}
    for name, work in (("frame_ms", frame), ("step_ms", step)):
        times = []
        for _ in range(WARM_UP + int(repeat)):
            torch.cuda.synchronize()
            start = time.perf_counter()
            work()
            torch.cuda.synchronize()
            times.append(1e3 * (time.perf_counter() - start))
        found[name] = statistics.median(times[WARM_UP:])
    print(json.dumps(found))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
