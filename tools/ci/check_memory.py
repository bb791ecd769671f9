#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Check every kernel with Oclgrind: reads and writes out of bounds, data races, values read before they are written.

    python tools/ci/check_memory.py [--short] [--shapes 1x64,8x1] [--jobs N] [--keep FOLDER]

Runs `memory_workload.py` in child processes whose only device is Oclgrind's (Debian and Ubuntu: apt install oclgrind),
once for bounds, races and API calls, and once for uninitialised values. Prints each finding with its kernel and line.
With --short, as in CI, pictures are of one tile or two, training's methods take one step, and the parts of WHOLE_ONLY
are left out. Every kernel still runs in every build (`-D` options) that it has without --short. The exit status is 0
if nothing was found, and 2 without Oclgrind. It is 1 if there are findings, or if a planted fault was missed. It is 1
also if a kernel never ran, or if a part that --short leaves out has a build of its own.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from memory_workload import PARTS, WHOLE_ONLY

from clsplat.device.source import _INCLUDE, kernel_root, kernel_source

LIBRARY = "lib/oclgrind/liboclgrind-rt-icd.so"
WORKLOAD = Path(__file__).with_name("memory_workload.py")
COMMON_OPTIONS = "-D__has_builtin(x)=0"  # Oclgrind has no prefetch
CHECKS = {
    # Functions are not inlined, as Oclgrind does not know LLVM 14's metadata of pointers that do not overlap.
    "races": {"OCLGRIND_DATA_RACES": "1", "OCLGRIND_BUILD_OPTIONS": f"-fno-inline {COMMON_OPTIONS}"},
    # Nothing is optimised, as Oclgrind does not know LLVM's `freeze`.
    "uninitialised": {"OCLGRIND_UNINITIALIZED": "1", "OCLGRIND_BUILD_OPTIONS": f"-O0 {COMMON_OPTIONS}"},
}
"""Environment variables of each check. Both also check bounds and API calls."""

PLANTED = {
    "races": {"planted_bounds": "Invalid write", "planted_race": "data race"},
    "uninitialised": {"planted_bounds": "Invalid write", "planted_uninitialised": "Uninitialized"},
}
"""Findings that each check must report for the faults in memory_workload.PLANTED."""

ACCEPTED = (
    (
        re.compile(r"runtime error detected\s+Function: clGetDeviceInfo\s+Error:\s+CL_INVALID_VALUE"),
        "pyopencl asks every device for its shared virtual memory when it makes a kernel, which came with OpenCL 2.0",
    ),
)
"""Findings that are ignored: a pattern of the whole finding, and the reason."""


STARTS = r"^(?=Invalid |Uninitialized |Controlflow |\S+-\S+ data race|Oclgrind|OCLGRIND|\S.*detected)"
"""Pattern of the beginning of a finding in a log."""


@dataclass(frozen=True)
class Finding:
    """A finding of Oclgrind, without numbers that differ from run to run. kernel, place: empty if not named in it."""

    message: str
    kernel: str = ""
    place: str = ""

    def __str__(self) -> str:
        return ": ".join(filter(None, (self.kernel, self.place, self.message)))


def library() -> Path | None:
    """Oclgrind's OpenCL driver, or None."""
    program = shutil.which("oclgrind")
    prefixes = [*([Path(program).resolve().parents[1]] if program else []), Path("/usr"), Path("/usr/local")]
    return next((path for prefix in prefixes if (path := prefix / LIBRARY).is_file()), None)


def kernels() -> dict[str, list[str]]:
    """Stems of the kernel files, keyed by kernel. Files that share a header may have a kernel of the same name."""
    pattern = re.compile(r"__kernel\s+void\s+(\w+)\s*\(")
    found: dict[str, list[str]] = {}
    for path in sorted(kernel_root().glob("*.cl")):
        for name in dict.fromkeys(pattern.findall(kernel_source(path.stem))):
            found.setdefault(name, []).append(path.stem)
    return found


def places(stem: str) -> list[str]:
    """FILE:LINE of every line that a driver compiles for `stem`.cl, see `clsplat.device.source.kernel_source`."""
    seen: set[str] = set()
    found: list[str] = []

    def append(name: str) -> None:
        if name in seen:
            return
        seen.add(name)
        for number, line in enumerate((kernel_root() / name).read_text(encoding="utf-8").splitlines(), 1):
            if match := _INCLUDE.match(line):
                append(match.group(1))
            else:
                found.append(f"kernels/{name}:{number}")

    append(f"{stem}.cl")
    return found


def findings(log: str, stems: Mapping[str, Sequence[str]]) -> tuple[Counter[Finding], Counter[str]]:
    """Count the findings in a log, and the reasons of the ignored findings. stems: from `kernels`."""
    found: Counter[Finding] = Counter()
    accepted: Counter[str] = Counter()
    for text in re.split(STARTS, log, flags=re.MULTILINE):
        if not text.strip() or re.fullmatch(r"\s*\d+ warnings? generated\.\s*", text):
            continue
        reason = next((reason for pattern, reason in ACCEPTED if pattern.search(text)), None)
        if reason:
            accepted[reason] += 1
            continue
        message = re.sub(r"0x[0-9a-f]+", "0x...", " ".join(text.split("\tEntity")[0].split()))
        message = message.split(" Kernel: ")[0]
        kernel = re.search(r"Kernel:\s+(\w+)", text)
        line = re.search(r"At line (\d+)", text)
        listed = [places(stem) for stem in stems.get(kernel[1], [])] if kernel and line else []
        place = " or ".join(lines[int(line[1]) - 1] for lines in listed if line and int(line[1]) <= len(lines))
        found[Finding(message, kernel[1] if kernel else "", place)] += 1
    return found, accepted


@dataclass(frozen=True)
class Result:
    """The result of a child process: its name, exit status, output, and Oclgrind's log."""

    name: str
    status: int
    output: str
    log: str
    seconds: float


def run(shape: str, check: str, part: str, driver: Path, folder: Path, *, short: bool = False) -> Result:
    """Run a part of the workload in a child process whose only device is Oclgrind's.

    check: a key of CHECKS. driver: Oclgrind's. folder: gets the log. short: True for the short form of --short.
    """
    vendors = folder / "vendors"
    vendors.mkdir(exist_ok=True)
    (vendors / "oclgrind.icd").write_text(f"{driver}\n")
    name = f"{shape} {check} {part}".rstrip()
    log = folder / f"{name.replace(' ', '-')}.log"
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("OCLGRIND_", "CLSPLAT_"))}
    environment |= CHECKS[check]
    environment |= {
        "OCL_ICD_VENDORS": str(vendors),
        "OCLGRIND_CHECK_API": "1",
        "OCLGRIND_LOG": str(log),
        "OCLGRIND_MAX_ERRORS": "10000",
        "OCLGRIND_GLOBAL_MEM_SIZE": str(1 << 30),
        "OCLGRIND_NUM_THREADS": "1",
        "CLSPLAT_TRUST_DRIVER": "1",  # no sandbox, as a crash ends only this child process
        "PYOPENCL_NO_CACHE": "1",  # one check must not load the builds of the other from the cache
        "PYTHONPATH": os.pathsep.join(filter(None, (str(WORKLOAD.parents[2]), os.environ.get("PYTHONPATH", "")))),
    }
    words = [word for word, wanted in (("plain", check == "uninitialised"), ("short", short)) if wanted]
    command = [sys.executable, str(WORKLOAD), shape, part, *words]
    start = time.monotonic()
    done = subprocess.run(command, env=environment, capture_output=True, text=True, errors="replace", check=False)
    logged = log.read_text(errors="replace") if log.exists() else ""
    return Result(name, done.returncode, done.stdout, logged + done.stderr, time.monotonic() - start)


def report(result: Result, stems: Mapping[str, Sequence[str]]) -> bool:
    """Print the findings of a child process. Returns True if there are none. stems: from `kernels`."""
    found, accepted = findings(result.log, stems)
    print(f"{result.name}: {sum(found.values())} findings, {result.seconds:.0f} s")
    for reason, count in accepted.items():
        print(f"  accepted, {count} times: {reason}")
    for finding, count in found.most_common():
        print(f"  {finding} ({count} times)")
    if result.status != 0:
        last = result.output.split()[-1:] or ["nothing"]
        print(f"  ended with status {result.status}; the last kernel was {last[0]}")
    return result.status == 0 and not found


def report_planted(result: Result, check: str) -> bool:
    """Print the planted faults that were missed. Returns True if none were and the child process succeeded."""
    found, _ = findings(result.log, {})
    missing = [
        name
        for name, message in PLANTED[check].items()
        if not any(finding.kernel == name and message in finding.message for finding in found)
    ]
    print(f"{result.name}: {len(PLANTED[check]) - len(missing)} of {len(PLANTED[check])} faults found")
    for name in missing:
        print(f"  not found: {name}")
    return result.status == 0 and not missing


def report_builds(builds: Mapping[tuple[str, str], set[str]], kernels: set[str]) -> bool:
    """Print the kernels that never ran, and the builds that --short would leave out. Returns True if there are none.

    builds: sets of "SHAPE KERNEL@BUILD" that ran, keyed by check and form. The form is "short" for parts that run with
        --short, "whole" for parts that it leaves out.
    kernels: names of all kernels.
    """
    clean = True
    for check in CHECKS:
        short, whole = (builds.get((check, form), set()) for form in ("short", "whole"))
        never = kernels - {each.split()[1].partition("@")[0] for each in short | whole}
        if never:  # in no shape, as some kernels are built only in some shapes
            print(f"{check}, never ran: {', '.join(sorted(never))}")
        for build in sorted(whole - short):
            print(f"{check}, the short form would leave out: {build}")
        clean &= not never and whole <= short
    return clean


def main(arguments: list[str]) -> int:
    """Run the checks that the module describes."""
    parser = argparse.ArgumentParser(prog="check_memory", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--short", action="store_true", help="small pictures, few steps, and every build nevertheless")
    parser.add_argument("--shapes", default="1x64,8x1", help="kernel shapes, LANESxITEMS with 1 or 8 lanes")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="children at once")
    parser.add_argument("--keep", type=Path, help="folder for Oclgrind's logs and builds.txt")
    options = parser.parse_args(arguments)
    driver = library()
    if driver is None:
        print("check_memory: error: no Oclgrind found, expected it from: apt install oclgrind", file=sys.stderr)
        return 2
    stems = kernels()
    shapes = options.shapes.split(",")
    parts = [part for part in PARTS if not (options.short and part in WHOLE_ONLY)]
    asked = [(shape, check, part) for shape in shapes for check in reversed(CHECKS) for part in parts]
    asked += [("planted", check, "") for check in CHECKS]  # the longest parts begin first
    with tempfile.TemporaryDirectory(prefix="clsplat-memory-") as scratch:
        folder = options.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        with ThreadPoolExecutor(max(options.jobs, 1)) as pool:
            results = list(
                pool.map(lambda each: run(each[0], each[1], each[2], driver, folder, short=options.short), asked)
            )
    clean = True
    builds: dict[tuple[str, str], set[str]] = {}
    for (shape, check, part), result in zip(asked, results, strict=True):
        if shape == "planted":
            clean &= report_planted(result, check)
            continue
        clean &= report(result, stems)
        # with the shape, as each shape has builds of its own
        ran = {f"{shape} {word}" for word in result.output.split()}
        builds.setdefault((check, "whole" if part in WHOLE_ONLY else "short"), set()).update(ran)
    clean &= report_builds(builds, set(stems))
    if options.keep:
        (folder / "builds.txt").write_text("".join(f"{line}\n" for line in sorted(set().union(*builds.values()))))
    many = len(set().union(*builds.values()))
    print(f"{len(stems)} kernels, {many} builds in {len(shapes)} shapes: {'clean' if clean else 'NOT clean'}")
    return int(not clean)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
