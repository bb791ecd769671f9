#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Write docs/gpus/devices.md, the page of devices and their times, from reports of `clsplat selftest --report`.

    python tools/gpu/device_page.py report.json...    adds the reports' devices to docs/gpus/devices.json first
    python tools/gpu/device_page.py

Reports contain paths and packages of a machine; devices.json keeps only what the page shows. A new row replaces the row
of the same device, driver, system and shape. Devices that failed the test, or have no times, are left out with a
message.
"""

from __future__ import annotations

import json
import re
import sys
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "bench"))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from gpu_measured import PARTS
from gpu_page import fill_in, markdown
from measuring import plain_parser, require, tool

from clsplat.device.drivers.shapes import Shape
from clsplat.files.atomic import atomic_write

FOLDER = Path(__file__).resolve().parents[2] / "docs/gpus"
PAGE, ROWS = FOLDER / "devices.md", FOLDER / "devices.json"
KEY = ("device", "driver", "system", "shape")
"""Fields that identify a row."""
Row = dict[str, Any]


def rows_of(report: Mapping[str, Any]) -> tuple[list[Row], list[str]]:
    """The rows of a report, and descriptions of devices that are left out. Raises KeyError if it is not a report."""
    system = next(line["text"] for line in report["installation"] if line["part"] == "system")
    rows, left_out = [], []
    for device in report["devices"]:
        driver = device["version"].split("  ")[0].strip()
        times = device.get("times") or {"failed": "no times" if device["trusted"] else device["verdict"]}
        if "failed" in times:
            left_out.append(f"{device['name']}, {driver}: {times['failed']}")
            continue
        row = {
            "device": device["name"],
            "kind": device["kind"],
            "units": device["compute_units"],
            "driver": driver,
            "system": re.sub(r"(\d+\.\d+)[^\s,]*", r"\1", system),  # only the first two numbers of the system's version
            "date": report["date"],
            "clsplat": report["clsplat"],
            "shape": Shape(**times["shape"], chunks=1).label,
            "bits": bits_of(device),
            "digests": f"{zlib.crc32(json.dumps(device['digests'], sort_keys=True).encode()):08x}",
            "load": round(times["load_average"] or 0, 1),
            "timer": times["timer"],
            "frame_ms": round(times["frame_ms"], 3),
            "step_ms": round(times["iteration_ms"], 3),
            "stages_ms": {name: round(stage["ms"], 4) for name, stage in times["stages"].items()},
        }
        rows.append(row)
    return rows, left_out


def bits_of(device: Mapping[str, Any]) -> str:
    """`same`, or text with the stages whose results have other bits than those stored with clsplat."""
    other = [stage["stage"] for stage in device["stages"] if stage["same_bits"] is False]
    return f"other in {', '.join(other)}" if other else "same"


def merged(rows: Sequence[Row], new: Sequence[Row]) -> list[Row]:
    """All rows, where new rows replace old ones with the same KEY. GPUs come first, and fast before slow devices."""
    found = {tuple(row[name] for name in KEY): row for row in (*rows, *new)}
    return sorted(found.values(), key=lambda row: (row["kind"] != "gpu", row["step_ms"]))


def tables(rows: Sequence[Row]) -> dict[str, str]:
    """The page's tables by name."""
    devices = [["device", "kind", "units", "driver", "system", "date", "shape", "bits", "digests"]]
    devices += [[str(row[name]) for name in devices[0]] for row in rows]
    times = [["device, driver", "steps a second", "step, ms", "frame, ms", *PARTS, "load"]]
    for row in rows:
        stages = row["stages_ms"]
        parts = [sum(stages.get(name, 0.0) for name in members) for members in PARTS.values()]
        walls = (f"{1e3 / row['step_ms']:.0f}", f"{row['step_ms']:.2f}", f"{row['frame_ms']:.2f}")
        named = f"{row['device']}, {row['driver']}" + ("" if row["timer"] == "events" else " (wall times)")
        times.append([named, *walls, *(f"{ms:.3f}" for ms in parts), f"{row['load']:.1f}"])
    return {"devices": markdown(devices), "times": markdown(times)}


@tool("device_page")
def main(arguments: Sequence[str]) -> int:
    """Add the reports, and write the page."""
    parser = plain_parser(__doc__, prog="device_page")
    parser.add_argument("reports", metavar="report.json", type=Path, nargs="*")
    rows = json.loads(ROWS.read_text("utf-8"))
    for path in parser.parse_args(arguments).reports:
        try:
            new, left_out = rows_of(json.loads(path.read_text("utf-8")))
        except (ValueError, KeyError, TypeError, StopIteration):
            new, left_out = [], []
            require(False, f"{path}: is no report, expected the file of clsplat selftest --report")
        rows = merged(rows, new)
        for text in left_out:
            print(f"left out: {text}", file=sys.stderr)
    atomic_write(ROWS, (json.dumps(rows, indent=1) + "\n").encode())
    atomic_write(PAGE, fill_in(PAGE.read_text("utf-8"), tables(rows), PAGE.name).encode())
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
