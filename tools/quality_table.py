#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""The README's table of quality from run folders: a row for each evaluation in metrics.jsonl and eval.json.

python tools/quality_table.py runs/fox runs/lego ...
"""

from __future__ import annotations

import json
import sys
from pathlib import Path


def rows(run: Path) -> list[str]:
    """Markdown rows of one run, by step."""
    lines = (run / "metrics.jsonl").read_text("utf-8").splitlines()
    records = [json.loads(line) for line in lines if '"eval"' in line]
    results = {record["eval"]["step"]: record["eval"] for record in records}
    if (run / "eval.json").exists():
        last = json.loads((run / "eval.json").read_text("utf-8"))
        results[last["step"]] = last
    return [
        f"| {run.name} | {step} | {result['mean']['psnr']:.2f} | {result['mean']['ssim']:.4f} | "
        f"{result['gaussians']:,} | {result['seconds']:.0f} |"
        for step, result in sorted(results.items())
    ]


def main(arguments: list[str]) -> int:
    """Print the table."""
    if not arguments:
        print(__doc__, file=sys.stderr)
        return 2
    print("| scene | steps | PSNR | SSIM | Gaussians | seconds |\n|---|---|---|---|---|---|")
    for name in arguments:
        print("\n".join(rows(Path(name))))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
