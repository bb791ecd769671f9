#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Points without colours against the same with them: held-out PSNR of scenes that are trained from both.

    .venv/bin/python tools/quality_colours.py FOLDER SCENE... [--iterations 2000] [--resolution 0] [--seed 0]

The scenes are COLMAP's. A copy with points of one colour goes to FOLDER/NAME/scene; FOLDER/NAME/coloured is trained
from the scene, FOLDER/NAME/bare from the copy. Runs that are there are not made again. The table has PSNR by step.
"""

from __future__ import annotations

import argparse
import json
import shutil
import struct
from pathlib import Path

from quality_points import trained


def without_colours(scene: Path, copy: Path) -> Path:
    """A copy of a COLMAP folder whose points are grey, with a link to the photographs."""
    copied = shutil.copytree(scene / "sparse" / "0", copy / "sparse" / "0", dirs_exist_ok=True) / "points3D.bin"
    data = bytearray(copied.read_bytes())
    (count,), place = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        (track,) = struct.unpack_from("<Q", data, place + 43)
        data[place + 32 : place + 35] = bytes([128, 128, 128])
        place += 51 + 8 * track
    copied.write_bytes(data)
    if not (copy / "images").exists():
        (copy / "images").symlink_to((scene / "images").resolve())
    return copy


def scores(run: Path) -> dict[int, float]:
    """PSNR in dB by the step of the evaluation."""
    records = [json.loads(line) for line in (run / "metrics.jsonl").read_text("utf-8").splitlines()]
    steps = {record["step"]: record["eval"]["mean"]["psnr"] for record in records if "eval" in record}
    last = json.loads((run / "eval.json").read_text("utf-8"))
    return {**steps, last["step"]: last["mean"]["psnr"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--iterations", type=int, default=2000)
    parser.add_argument("--resolution", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rows = []
    for path in options.scenes:
        folder = options.folder / path.name
        early = ",".join(str(step) for step in (300, 1000) if step < options.iterations)
        words = ["--iterations", str(options.iterations), "--seed", str(options.seed), "--eval-at", early]
        words += ["--resolution", str(options.resolution)]
        for kind, scene in (("coloured", path), ("bare", without_colours(path, folder / "scene"))):
            trained(scene, folder / kind, words)
            values = scores(folder / kind)
            rows.append(f"| {path.name} | {kind} | {' | '.join(f'{value:.2f}' for value in values.values())} |")
    print(f"| scene | points | {' | '.join(map(str, values))} |\n|---|---{'|---' * len(values)}|")
    print("\n".join(rows))


if __name__ == "__main__":
    main()
