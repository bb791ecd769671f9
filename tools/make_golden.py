#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Write tests/golden/loss_curve.json: the losses of 20 steps of the tests' tiny training, which the tests repeat.

    .venv/bin/python tools/make_golden.py

Run it, and commit what it writes, only where a change is meant to change training; say why in the commit.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT)]

TARGET = ROOT / "tests" / "golden" / "loss_curve.json"


def main() -> int:
    """Train on the default device and write the losses."""
    from tiny import loss_curve, write_scene

    from clsplat.device.context import open_device
    from clsplat.scene import load_scene

    device = open_device()
    with tempfile.TemporaryDirectory() as folder:
        scene = load_scene(write_scene(Path(folder) / "scene"))
        losses = loss_curve(scene, device)
    TARGET.write_text(
        json.dumps({"made_on": f"{device.name}, {device.driver.split('  ')[0]}", "losses": losses}, indent=2) + "\n"
    )
    print(f"{TARGET}: {len(losses)} losses, {losses[0]:.6f} to {losses[-1]:.6f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
