#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Run ten steps of four public programs that call gsplat, with clsplat in place of gsplat, and without CUDA.

python tools/ci/gsplat_programs.py --programs DIR        # DIR has a checkout of each, named as in PROGRAMS

Each program's own model, loss and loop run; the few lines below give it Gaussians and cameras. In its sources `cuda` is
replaced by `cpu`. Modules that it imports but does not call here (file readers, viewers, other CUDA rasterizers) may be
missing. GsplatLoc does call kornia and small_gicp, and needs them. Prints the commit, and the first and last loss. The
exit status is 1 if a program fails or its loss does not fall.
"""

from __future__ import annotations

import argparse
import math
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from gsplat_tests import commit_of

STEPS = 10
BEFORE = """
import importlib.abc, importlib.machinery, importlib.util, math, sys, types
from unittest.mock import MagicMock
import torch
class Missing(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    def find_spec(self, name, path, target=None):
        wanted = any(name == each or name.startswith(each + ".") for each in MISSING)
        return importlib.machinery.ModuleSpec(name, self, is_package=True) if wanted else None
    def create_module(self, spec):
        module = MagicMock(name=spec.name)
        module.__path__, module.__spec__ = [], spec
        return module
    def exec_module(self, module): pass
sys.meta_path.append(Missing())
torch.cuda.synchronize = lambda: None
import clsplat.torch
clsplat.torch.install_as_gsplat()
torch.manual_seed(0)
N = 500
points = torch.rand(N, 3) * torch.tensor([2.0, 1.5, 2.0]) + torch.tensor([-1.0, -0.75, 3.0])
colours = torch.rand(N, 3)
def said(step, loss): print(f"step {step}: loss {float(loss):.9g}", flush=True)
"""
"""Lines that run before each program's lines and after MISSING: install clsplat as gsplat, and create 500 points."""


@dataclass(frozen=True)
class Program:
    """A program: its folder in DIR, and lines that run STEPS steps and print their losses.

    where: subfolder that is put on Python's path.
    missing: modules that may be missing.
    falls: True if the last loss has to be below the first, as in a training.
    """

    folder: str
    where: str
    missing: tuple[str, ...]
    lines: str
    falls: bool = True


PROGRAMS = (
    Program(
        "gsplat",
        "examples",
        (),
        f"""
import image_fitting
image_fitting.main(height=256, width=256, num_points=2000, save_imgs=False, iterations={STEPS})
""",
    ),
    Program(
        "3dgs-gradient-backprojection",
        ".",
        ("pycolmap_scene_manager", "plyfile"),
        f"""
import numpy, utils
losses = []
backward = torch.Tensor.backward
def told(loss, *more):
    losses.append(loss.item())
    backward(loss, *more)
torch.Tensor.backward = told
class Photograph:
    def __init__(self, step): self.name, self.t = f"{{step:02}}", numpy.array([0.1 * step, 0.0, 0.2 * step])
    def R(self): return numpy.eye(3)
splats = dict(
    colmap_project=types.SimpleNamespace(images={{step: Photograph(step) for step in range({STEPS})}}),
    camera_matrix=torch.tensor([[200.0, 0, 80], [0, 200, 60], [0, 0, 1]]), means=points,
    features_dc=torch.ones(N, 1, 3), features_rest=torch.zeros(N, 15, 3), scaling=torch.full((N, 3), -4.0),
    rotation=torch.eye(4)[0].repeat(N, 1), opacity=torch.zeros(N))
splats["means"][:50, 2] = -5.0  # behind all cameras
left = utils.prune_by_gradients(splats)
assert len(left["means"]) == N - 50, len(left["means"])
for step, loss in enumerate(losses): said(step, loss)
""",
        falls=False,
    ),
    Program(
        "gaussian-splatting",
        ".",
        (
            *("gaussian_splatting.diff_gaussian_rasterization", "gaussian_splatting.simple_knn", "plyfile", "cv2"),
            *("tifffile", "open3d", "torchvision", "lpips", "tqdm", "scipy"),
        ),
        f"""
from gaussian_splatting import build_camera
from gaussian_splatting.models.gsplat import GsplatGaussianModel
from gaussian_splatting.trainer.base import BaseTrainer
model = GsplatGaussianModel(1)
model._xyz, model._features_dc = points, (colours[:, None] - 0.5) / 0.2820948
model._features_rest, model._scaling = torch.zeros(N, 3, 3), torch.full((N, 3), -3.0)
model._rotation, model._opacity = torch.eye(4)[0].repeat(N, 1), torch.zeros(N, 1)
model.to("cpu")
camera = build_camera(96, 128, 0.7, 0.53, torch.eye(3), torch.zeros(3), device="cpu")
camera = camera._replace(ground_truth_image=torch.full((3, 96, 128), 0.25))
trainer = BaseTrainer(model, types.SimpleNamespace(scene_extent=lambda: 1.0))
for step in range({STEPS}):
    loss, out = trainer.step(camera)
    assert out["get_viewspace_grad"](out).abs().sum() > 0
    said(step, loss)
""",
    ),
    Program(
        "GsplatLoc",
        ".",
        ("nerfview", "viser", "cv2", "natsort", "torchmetrics", "matplotlib", "open3d", "sklearn", "PIL", "wandb"),
        f"""
import src.data
from src.my_gsplat.loss import compute_depth_loss
from src.my_gsplat.model import CameraOptModule_quat_tans, GSModel
Ks = torch.tensor([[[150.0, 0, 64], [0, 150, 48], [0, 0, 1]]])
model, pose = GSModel(points, colours), torch.eye(4)
with torch.no_grad():
    wanted = model(pose[None], Ks, 128, 96)[0][..., 3:4]
pose[:3, 3] = torch.tensor([0.01, -0.01, 0.02])
camera = CameraOptModule_quat_tans(pose)
for step in range({STEPS}):
    camera.optimizer_clean()
    depths = model(camera()[None], Ks, 128, 96)[0][..., 3:4]
    loss = compute_depth_loss(depths, wanted)
    loss.backward(retain_graph=True)
    camera.optimizer_step()
    said(step, loss)
""",
    ),
)


def main(arguments: list[str]) -> int:
    """Run the programs. Returns 1 if one fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--programs", type=Path, required=True, metavar="DIR")
    parser.add_argument("--only", metavar="NAME", help="one of them, by its folder's name")
    asked = parser.parse_args(arguments)
    failed = 0
    for program in PROGRAMS:
        if asked.only in {None, program.folder}:
            failed += not _runs(program, asked.programs.resolve() / program.folder)
    return 1 if failed else 0


def _runs(program: Program, folder: Path) -> bool:
    """Run a program. Returns True if its loss falls."""
    with tempfile.TemporaryDirectory() as temporary:
        for source in sorted(folder.rglob("*.py")):
            copy = Path(temporary) / source.relative_to(folder)
            copy.parent.mkdir(parents=True, exist_ok=True)
            text = re.sub(r"""(["'])cuda(:0)?\1""", r"\1cpu\1", source.read_text("utf-8", "replace"))
            copy.write_text(text, "utf-8")
        code = (
            f"MISSING = {program.missing!r}\n{BEFORE}\nsys.path.insert(0, {str(Path(temporary) / program.where)!r})\n"
        )
        command = [sys.executable, "-c", code + program.lines]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=temporary)
    losses = [float(found) for found in re.findall(r"[Ll]oss:? ([\d.e+-]+)", done.stdout)]
    commit = commit_of(folder)
    if done.returncode or len(losses) != STEPS or not all(map(math.isfinite, losses)):
        print(f"{program.folder}, commit {commit}: {(done.stderr.strip() or 'no losses').splitlines()[-1]}")
        return False
    print(f"{program.folder}, commit {commit}: {len(losses)} steps, loss {losses[0]:.6f} to {losses[-1]:.6f}")
    return losses[-1] < losses[0] or not program.falls


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
