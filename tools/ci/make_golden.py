#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Write the files of tests/golden/, which tests compare with: losses of 20 steps of the tests' tiny training, and
checksums of frames and gradients. Also write clsplat/selftest/digests.json, with which `clsplat selftest` compares.

    .venv/bin/python tools/ci/make_golden.py [loss_curve] [frames] [selftest]

Run it and commit its files only after a change that is meant to change training, or the bits of frames or gradients;
explain the change in the commit. Without a name it writes all three files. The default device must support 16 lanes.

tests/golden/README.md has the differences that the tests allow.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))

from golden_frames import checksums
from tiny import loss_curve, write_scene

from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.scenes.loading import load_scene
from clsplat.selftest.worker import run, shape_label

ROOT = Path(__file__).resolve().parents[2]
GOLDEN = ROOT / "tests" / "golden"


def main(names: list[str]) -> int:
    """Write the files on the default device."""
    makers = {"loss_curve": write_loss_curve, "frames": write_frames, "selftest": write_selftest}
    paths = {"selftest": ROOT / "clsplat" / "selftest" / "digests.json"}
    for name in names or list(makers):
        if name not in makers:
            print(__doc__, file=sys.stderr)
            return 2
        makers[name](paths.get(name, GOLDEN / f"{name}.json"))
    return 0


def write_loss_curve(path: Path) -> None:
    """Train and write the losses."""
    device = open_device()
    with tempfile.TemporaryDirectory() as folder:
        scene = load_scene(write_scene(Path(folder) / "scene"))
        losses = loss_curve(scene, device)
    _write(path, device, {"losses": losses})
    print(f"{path}: {len(losses)} losses, {losses[0]:.6f} to {losses[-1]:.6f}")


def write_frames(path: Path) -> None:
    """Render and write the checksums."""
    device = open_device()
    sums = checksums(device)
    _write(path, device, {"checksums": sums})
    print(f"{path}: {len(sums)} scenes")


SHAPES = (
    *("1x1", "1x16", "1x32", "1x64", "1x128", "1x256", "1x32g", "1x64g"),
    *("4x1", "8x1", "8x16", "16x1"),
)
"""Shapes whose gradients get a digest: defaults of devices, and shapes that the tests use."""
ORDERED = ("/loss", "/masks", "/blend_grad", "/values")
"""Stages in which the order of sums depends on the shape."""


def write_selftest(path: Path) -> None:
    """Run the self-test in every shape, and write the digests: one per result, but one per result and shape for the
    stages in ORDERED."""
    device = open_device()
    by_shape: dict[str, dict[str, str]] = {}
    for label in SHAPES:
        shaped = device.with_shape(label)
        found = by_shape.setdefault(shape_label(shaped), {})
        for result in run(shaped, digests=found):
            if not result.passed:
                raise SystemExit(f"{label}: {result}")
    digests: dict[str, object] = {}
    for name in next(iter(by_shape.values())):
        by = {shape: found[name] for shape, found in by_shape.items()}
        digests[name] = by if name.endswith(ORDERED) else by["8x1"]
        if not name.endswith(ORDERED) and len(set(by.values())) > 1:
            raise SystemExit(f"{name}: {by}, expected the same bits in every shape")
    _write(path, device, {"digests": digests})
    print(f"{path}: {len(digests)} digests")


def _write(path: Path, device: Device, content: dict[str, object]) -> None:
    made_on = f"{device.name}, {device.driver.split('  ')[0]}"
    path.write_text(json.dumps({"made_on": made_on, **content}, indent=2) + "\n")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
