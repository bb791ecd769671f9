#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Write what tests/golden/ holds and the tests repeat: the losses of 20 steps of the tests' tiny training, and
checksums of frames and gradients.

    .venv/bin/python tools/make_golden.py [loss_curve] [frames]

Run it, and commit what it writes, only where a change is meant to change training, or the bits of a frame or of a
gradient; say why in the commit. Without a name it writes both files.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from clsplat.device.context import Device

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "stages"), str(ROOT)]

GOLDEN = ROOT / "tests" / "golden"


def main(names: list[str]) -> int:
    """Write the files on the default device."""
    makers = {"loss_curve": write_loss_curve, "frames": write_frames}
    for name in names or list(makers):
        if name not in makers:
            print(__doc__, file=sys.stderr)
            return 2
        makers[name](GOLDEN / f"{name}.json")
    return 0


def write_loss_curve(path: Path) -> None:
    """Train and write the losses."""
    from tiny import loss_curve, write_scene

    from clsplat.device.context import open_device
    from clsplat.scene import load_scene

    device = open_device()
    with tempfile.TemporaryDirectory() as folder:
        scene = load_scene(write_scene(Path(folder) / "scene"))
        losses = loss_curve(scene, device)
    _write(path, device, {"losses": losses})
    print(f"{path}: {len(losses)} losses, {losses[0]:.6f} to {losses[-1]:.6f}")


def write_frames(path: Path) -> None:
    """Render and write the checksums."""
    from golden_frames import checksums

    from clsplat.device.context import open_device

    device = open_device()
    sums = checksums(device)
    _write(path, device, {"checksums": sums})
    print(f"{path}: {len(sums)} scenes")


def _write(path: Path, device: Device, content: dict[str, object]) -> None:
    made_on = f"{device.name}, {device.driver.split('  ')[0]}"
    path.write_text(json.dumps({"made_on": made_on, **content}, indent=2) + "\n")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
