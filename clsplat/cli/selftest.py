# SPDX-License-Identifier: Apache-2.0
"""`clsplat selftest`: its table, its sentences and its exit status."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict

from clsplat.cli.main import Selftest
from clsplat.device.context import DeviceInfo, find_device, list_devices
from clsplat.device.quirks import no_device
from clsplat.selftest.result import Result
from clsplat.selftest.trust import Report, examine_device

HEADER = ("stage", "worst error", "ulp", "allowed", "bits", "ms", "worst in")


def selftest(verb: Selftest) -> int:
    """Test the devices one after the other; 1 if one of them cannot be trusted."""
    found = list_devices() if verb.device in (None, "all") else [find_device(verb.device)]
    if not found:
        raise no_device()
    reports: list[Report] = []
    for info in found:
        if not verb.json:
            print(f"{'' if not reports else chr(10)}{info.index}: {name_of(info)}, {info.shape}", flush=True)
        report = examine_device(info.index)
        reports.append(report)
        if not verb.json:
            print(table(report))
            print(f"This driver {report.verdict}.", flush=True)
            if report.remembered:
                print(f"The shape is not used all the same: {report.remembered}.", flush=True)
    if verb.json:
        print(json.dumps([record(info, report) for info, report in zip(found, reports, strict=True)], indent=2))
    failed = [name_of(info) for info, report in zip(found, reports, strict=True) if report.failure]
    if failed:
        print(
            f"clsplat: error: {len(failed)} of {len(found)} drivers cannot be trusted: {'; '.join(failed)}",
            file=sys.stderr,
        )
    return 1 if failed else 0


def name_of(info: DeviceInfo) -> str:
    """Device and driver."""
    return f"{info.name}, {info.version.split('  ')[0].strip()}"


def record(info: DeviceInfo, report: Report) -> dict[str, object]:
    """Entry of a device for --json."""
    stages = [{**asdict(result), "passed": result.passed} for result in report.results]
    return {
        **asdict(info),
        "trusted": not report.failure,
        "verdict": report.verdict,
        "remembered": report.remembered,
        "build_seconds": report.build_seconds,
        "stages": stages,
    }


def table(report: Report) -> str:
    """Every stage with its worst error, or that it was not run."""
    rows: list[tuple[str, ...]] = [HEADER]
    if report.build_seconds is not None:
        rows.append(("build", "", "", "", "", f"{1e3 * report.build_seconds:.0f}", ""))
    rows += [_row(result) for result in report.results]
    done = {result.stage for result in report.results}
    rows += [(name, "not run", "", "", "", "", "") for name in report.wanted if name not in done]
    widths = [max(len(row[column]) for row in rows) for column in range(len(HEADER))]
    lines = []
    for row in rows:
        cells = [
            cell.ljust(w) if i in (0, 4, 6) else cell.rjust(w)
            for i, (cell, w) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def _row(result: Result) -> tuple[str, ...]:
    bits = {True: "same", False: "other", None: "-"}[result.same_bits]
    time = f"{result.ms:.1f}"
    if result.bound == 0:
        return result.stage, result.trouble or "exact", "", "0", bits, time, ""
    if result.trouble:
        return result.stage, "wrong", f"{result.ulp:.1f}", f"{result.bound:g}", bits, time, result.trouble
    where = result.where if result.passed else f"{result.where}: WRONG"
    return result.stage, f"{result.absolute:.1e}", f"{result.ulp:.1f}", f"{result.bound:g}", bits, time, where
