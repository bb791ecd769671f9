# SPDX-License-Identifier: Apache-2.0
"""`clsplat selftest`: test of every OpenCL driver, its table of results, and the file for a bug report."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from clsplat.cli.options import Flag, Verb
from clsplat.cli.session import Services, chosen_devices
from clsplat.files.atomic import atomic_write, check_new
from clsplat.progress import aligned
from clsplat.version import package_version

if TYPE_CHECKING:
    from clsplat.device.selection import DeviceInfo
    from clsplat.selftest.driver_check import DriverReport
    from clsplat.selftest.result import Result

SELFTEST_TABLE_HEADER = ("stage", "worst error", "ulp", "allowed", "bits", "ms", "worst in")
"""Column titles of the printed table."""


@dataclass(frozen=True)
class SelftestVerb(Verb):
    """Test every device: build the kernels, compare each stage with its float64 reference and with stored digests.

    The exit status is 1 if a driver cannot be trusted. The verbs train, eval, render, view, bench, capture and demo run
    a short form of this test when they first use a device. So does convert, if it renders. CLSPLAT_TRUST_DRIVER=1 skips
    the short form. This verb tests a device's preferred kernel shape even if its driver failed in this shape before.
    """

    device: Annotated[str | None, arg(metavar="DEVICE")] = "all"
    """all, or one device: an index, cpu, gpu, or part of a name, as listed by `clsplat devices`."""
    json: Flag = False
    """Print the result as JSON."""
    report: Annotated[Path | None, arg(metavar="FILE.json")] = None
    """Write a file for a bug report, with the result, the system, its packages, the limits of each device, and digests.
    It also has kernel shapes and kernels that failed with a driver, and times of the stages of a frame and a step."""
    overwrite: Flag = False
    """Replace an existing file."""


def run(verb: SelftestVerb, _: Services) -> int:
    """Test the devices one after the other. Returns 1 if any driver cannot be trusted."""
    from clsplat.selftest.driver_check import examine_device

    if verb.report is not None:
        check_new(verb.report, overwrite=verb.overwrite)
    devices = chosen_devices(None if verb.device == "all" else verb.device)
    reports: list[DriverReport] = []
    for info in devices:
        if not verb.json:
            print(f"{'' if not reports else chr(10)}{info.index}: {name_of(info)}, {info.shape}", flush=True)
        report = examine_device(info.index)
        reports.append(report)
        if not verb.json:
            print(table(report))
            print(f"This driver {report.verdict}.", flush=True)
            if report.remembered:
                print(f"The kernel shape that failed stays disabled: {report.remembered}.", flush=True)
    records = [record(info, report) for info, report in zip(devices, reports, strict=True)]
    if verb.json:
        print(json.dumps(records, indent=2))
    if verb.report is not None:
        atomic_write(verb.report, (json.dumps(_bug_report(records), indent=2) + "\n").encode())
        print(f"Wrote {verb.report}.", file=sys.stderr if verb.json else sys.stdout)
    failed = [name_of(info) for info, report in zip(devices, reports, strict=True) if report.failure]
    if failed:
        print(
            f"clsplat: error: {len(failed)} of {len(devices)} drivers cannot be trusted: {'; '.join(failed)}",
            file=sys.stderr,
        )
    return 1 if failed else 0


def name_of(info: DeviceInfo) -> str:
    """Return the name of a device and the version of its driver, as one text."""
    return f"{info.name}, {info.version.split('  ')[0].strip()}"


def record(info: DeviceInfo, report: DriverReport) -> dict[str, object]:
    """Return the object that --json prints for a device."""
    stages = [{**asdict(result), "passed": result.passed} for result in report.results]
    return {
        **asdict(info),
        "trusted": not report.failure,
        "verdict": report.verdict,
        "remembered": report.remembered,
        "build_seconds": report.build_seconds,
        "stages": stages,
        "digests": report.digests,
    }


def _bug_report(records: list[dict[str, object]]) -> dict[str, object]:
    """Return the content of --report: facts about the installation and about each device.

    records: the entry of each device (`record`). The device's limits, failures and times are added to its entry. Times
    are measured only on devices that can be trusted.
    """
    from clsplat.cli.doctor import lines
    from clsplat.device.context import all_devices
    from clsplat.device.drivers.shapes import failures
    from clsplat.device.selection import limits

    for entry, device in zip(records, (all_devices()[int(str(entry["index"]))] for entry in records), strict=True):
        entry |= {"limits": limits(device), "refused": failures(device)}
        entry["times"] = times(str(entry["index"])) if entry["trusted"] else None
    return {
        "clsplat": package_version(),
        "date": datetime.now(tz=timezone.utc).date().isoformat(),
        "installation": [asdict(line) for line in lines()],
        "devices": records,
    }


def times(device: str) -> dict[str, object]:
    """Return the times that `clsplat bench` measures on a view of the demo's scene.

    device: index of the device, as text.
    If the benchmark fails, the result is {"failed": reason}.
    """
    from clsplat.bench.stages import bench
    from clsplat.bench.workload import Subject
    from clsplat.demo.measured_view import measured_view
    from clsplat.device.selection import open_device
    from clsplat.errors import ClsplatError

    try:
        return bench(Subject("demo", *measured_view()), open_device(device, profile=True))
    except ClsplatError as error:
        return {"failed": str(error)}


def table(report: DriverReport) -> str:
    """Return the printed table: a row for each stage, with its worst error or the note "not run"."""
    rows: list[tuple[str, ...]] = [SELFTEST_TABLE_HEADER]
    if report.build_seconds is not None:
        rows.append(("build", "", "", "", "", f"{1e3 * report.build_seconds:.0f}", ""))
    rows += [_row(result) for result in report.results]
    done = {result.stage for result in report.results}
    rows += [(name, "not run", "", "", "", "", "") for name in report.wanted if name not in done]
    return "\n".join(aligned(rows, left=(0, 4, 6)))


def _row(result: Result) -> tuple[str, ...]:
    bits = {True: "same", False: "other", None: "-"}[result.same_bits]
    time = f"{result.ms:.1f}"
    if result.bound == 0:
        return result.stage, result.trouble or "exact", "", "0", bits, time, ""
    if result.trouble:
        return result.stage, "wrong", f"{result.ulp:.1f}", f"{result.bound:g}", bits, time, result.trouble
    where = result.where if result.passed else f"{result.where}: WRONG"
    return result.stage, f"{result.absolute:.1e}", f"{result.ulp:.1f}", f"{result.bound:g}", bits, time, where
