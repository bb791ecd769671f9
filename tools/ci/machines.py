#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Table of simulated machines: each runs the short self-test of its drivers and the smoke tests.

    .venv/bin/python tools/ci/machines.py [--list] [--only NAME,...] [--full NAME,...] [--short] [--jobs N]
        [--markdown]

All machines share this Python environment. They differ in drivers, environment variables, user, and the place of the
home folder, which is new, so that every driver is used for the first time. --list prints the machines' names, --only
selects some, and --full runs all of tools/test on some. --short leaves out machines whose drivers the machine `all`
has, and runs the smoke tests on few, without those of single kernels. --jobs sets how many run at once, and --markdown
prints the table for docs/machines.md.

PyPI's PoCL and Intel's runtime are found in this environment. Debian's PoCL is found through CLSPLAT_DEBIAN_POCL (its
libpocl.so) or in the system's list, and Rusticl through CLSPLAT_RUSTICL (its libRusticlOpenCL.so). Debian's QEMU is
found through CLSPLAT_QEMU (its program) or on the path. A machine whose parts are missing is "not run", with the
reason. The exit status is 1 if one failed. docs/machines.md has the purpose of each.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from machine_runs import HOOKS, ROOT, Drivers, Machine, Step, run_all
from opencl_drivers import BESIDE, SYSTEM_VENDORS
from processor import has_avx512

PYTHON = sys.executable

SHORT_LIMIT = 300
"""Time limit in seconds of the short self-test: 7 with PoCL on two free cores, 40 with four drivers, more if busy."""
SMOKE_LIMIT = 600
"""Time limit in seconds of the smoke tests: 27 with PoCL on two free cores, about 70 with four drivers, 211 if busy."""
FULL_LIMIT = 1200
"""Time limit in seconds of tools/test, which takes 6 minutes on two cores."""
TRAIN_LIMIT = 120
"""Time limit in seconds of ten steps on a tiny scene. The self-test has already built most of the kernels."""
EMULATED = 4
"""Factor of the time limits on an emulated processor: the short self-test takes 80 s of a core instead of 20."""
SMOKE = "smoke tests"
"""Name of the step of the smoke tests."""
SHORT_SMOKE = ("pypi-pocl-1-thread", "debian-pocl-sse2", "intel-corei7", "rusticl", "not-root", "odd-paths")
"""Machines with smoke tests in a short table: the least processor of each compiler, another user, odd paths. CI, which
makes that table, has already run all tests on the drivers of the others."""
IN_ALL = ("pypi-pocl", "debian-pocl", "intel", "intel-skx")
"""Machines that a short table leaves out: `all` tests their drivers in a new home too, and other machines have each of
these drivers alone. Intel's runtime builds for AVX-512 in `all` too where the processor has it."""

BUILT_KERNELS = "POCL_CACHE_DIR"
"""Environment variable with the caller's folder of kernels that PoCL has built. `lang-c` and `ascii` load kernels from
this folder. Only the encoding of text differs on these two machines, and builds do not depend on the encoding."""

SHORT = """
import sys
from clsplat.cli.main import main
from clsplat.device.selection import list_devices, open_device
from clsplat.device.drivers.driver_records import memory_path
from clsplat.errors import ClsplatError
from clsplat.selftest.driver_check import require
if memory_path().exists():
    sys.exit(f"{memory_path()}: exists, expected a home in which no driver is known")
if not list_devices():
    sys.exit("no OpenCL device")
try:
    for info in list_devices():
        require(open_device(str(info.index)))
except ClsplatError as error:
    sys.exit(str(error))
"""
"""Program that runs, for each driver, the test that `train` runs when it first uses a driver."""
SCENE = """
import sys
from pathlib import Path
sys.path.insert(0, {support!r})
from tiny import write_scene
write_scene(Path(sys.argv[1]))
"""


def short_test(limit: float = SHORT_LIMIT) -> Step:
    return Step("short self-test", (PYTHON, "-c", SHORT), limit)


OWN_SHAPE = "not 8x1-rusticl and not 1x1-rusticl"
"""Expression that selects smoke tests. Rusticl 22.3 runs work-groups of one item wrongly: the sort does not write its
output. Rusticl therefore uses 1x64 by default, and the self-test refuses shapes that fail."""


def smoke(*, stages: bool = True) -> Step:
    """The step of the smoke tests, from only the files that have any: collecting all tests takes 10 s more.

    stages: also test single kernels. False if only user or paths differ, as the self-test has run these kernels.
    """
    pytest = (PYTHON, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--no-header", "--tb=short")
    files = sorted(path for path in (ROOT / "tests").rglob("test_*.py") if "mark.smoke" in path.read_text("utf-8"))
    names = [str(path.relative_to(ROOT)) for path in files if stages or path.parent.name != "stages"]
    command = (*pytest, "-m", "smoke", "-k", OWN_SHAPE, *names)
    return Step(SMOKE, command, SMOKE_LIMIT, without="no tests ran")


def full() -> Step:
    """The step of the quick tests. It uses the binaries for Intel's runtime that the caller has cached, as building all
    of them would take minutes. Earlier steps do not use this cache."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    binaries = os.environ.get("CLSPLAT_BINARIES") or str(cache / "clsplat" / "binaries")
    command = ("env", f"CLSPLAT_BINARIES={binaries}", PYTHON, "tools/test", "--quiet")
    return Step("quick tests", command, FULL_LIMIT, without="no tests ran")


def ten_steps(folder: str, *, limit: float = TRAIN_LIMIT, status: int = 0, says: str = "") -> tuple[Step, Step]:
    """Two steps: write a tiny scene into a folder, and train it for ten steps."""
    scene, run = f"{folder}/scene", f"{folder}/run"
    tests = SCENE.format(support=str(ROOT / "tests" / "support"))
    train = (PYTHON, "-m", "clsplat", "train", scene, "-o", run, "--iterations", "10")
    return (
        Step("scene", (PYTHON, "-c", tests, scene), limit),
        Step("ten steps", train, limit, status=status, says=says),
    )


@dataclass(frozen=True)
class Found:
    """Drivers and programs from which machines are made. Fields are empty if something is missing."""

    pypi: bool
    intel: str
    debian: str
    rusticl: str
    qemu: str
    avx512: bool
    root: bool
    mounts: tuple[str, ...]
    """Command prefix to run a command with its own mounts; empty if that is not allowed."""
    stranger: tuple[str, ...]
    """Command prefix to run a command as a user other than root who can read the checkout; empty if not allowed."""


def look() -> Found:
    """Find the drivers and programs of this machine."""
    intel = Path(sys.prefix) / "lib" / "libintelocl.so"
    debian = os.environ.get(BESIDE, "")
    if not debian and (listed := SYSTEM_VENDORS / "pocl.icd").exists():
        debian = listed.read_text().strip()
    qemu = os.environ.get("CLSPLAT_QEMU", "") or shutil.which("qemu-x86_64") or shutil.which("qemu-x86_64-static") or ""
    return Found(
        pypi=any(Path(sys.prefix).glob("lib/python*/site-packages/pyopencl/.libs/pocl.icd")),
        intel=str(intel.resolve()) if intel.exists() else "",
        debian=debian,
        rusticl=os.environ.get("CLSPLAT_RUSTICL", ""),
        qemu=qemu,
        avx512=has_avx512(),
        root=_is_root(),
        mounts=_mounts(),
        stranger=_stranger(),
    )


def machines(found: Found) -> list[Machine]:
    """The machines of all rows. found: from `look`."""
    usual, elsewhere = (short_test(), smoke()), smoke(stages=False)
    no_pypi = "" if found.pypi else "pyopencl brings no PoCL here"
    no_debian = "" if found.debian else "the distribution's PoCL is missing"
    no_intel = "" if found.intel else "intel-opencl-rt is not installed"
    no_rusticl = "" if found.rusticl else "CLSPLAT_RUSTICL names no library"
    debian, intel, rusticl = ((("debian", found.debian),), (("intel", found.intel),), (("rusticl", found.rusticl),))
    no_avx512 = "" if found.avx512 else "this processor has no AVX-512"

    def alone(name: str, purpose: str, drivers: Drivers, missing: str, **variables: str) -> Machine:
        """A machine with these drivers alone, or with PyPI's PoCL if there are none. variables: of its environment."""
        own = tuple(variables.items())
        return Machine(name, purpose, usual, drivers, pypi=not drivers, variables=own, missing=missing)

    def at_home(name: str, purpose: str, *steps: Step, **changes: Any) -> Machine:
        """A machine with PyPI's PoCL, for another user or in another place. steps: those before the smoke tests.

        changes: other fields of `Machine`.
        """
        tests = (short_test(), *steps, elsewhere)
        return Machine(name, purpose, tests, pypi=True, **{"missing": no_pypi, **changes})

    made = ten_steps("{folder}/made")
    built = ((BUILT_KERNELS, os.environ[BUILT_KERNELS]),) if BUILT_KERNELS in os.environ else ()
    every = tuple(
        (name, path) for name, path in (*debian, *intel, *rusticl) if path
    )  # other rows report what is missing here
    return [
        alone("pypi-pocl", "what pip brings, alone", (), no_pypi),
        alone("pypi-pocl-1-thread", "the same, with one thread", (), no_pypi, POCL_MAX_PTHREAD_COUNT="1"),
        emulated(found, no_pypi),
        alone("debian-pocl", "the distribution's PoCL", debian, no_debian),
        alone("debian-pocl-sse2", "the same, its built-ins for SSE2", debian, no_debian, POCL_KERNELLIB_NAME="sse2"),
        alone("debian-pocl-avx2", "the same, its built-ins for AVX2", debian, no_debian, POCL_KERNELLIB_NAME="avx2"),
        alone("intel", "Intel's runtime", intel, no_intel),
        alone("intel-corei7", "the same, for SSE4.2", intel, no_intel, CL_CONFIG_CPU_TARGET_ARCH="corei7"),
        alone("intel-core-avx2", "the same, for AVX2", intel, no_intel, CL_CONFIG_CPU_TARGET_ARCH="core-avx2"),
        alone("intel-skx", "the same, for AVX-512", intel, no_intel or no_avx512, CL_CONFIG_CPU_TARGET_ARCH="skx"),
        alone("rusticl", "Mesa's Rusticl on llvmpipe, shaped as a GPU", rusticl, no_rusticl),
        Machine(
            "all",
            f"all of them together: {', '.join(['pypi', *(name for name, _ in every)])}",
            usual,
            every,
            pypi=True,
            missing=no_pypi or ("" if every else "there is one driver only"),
        ),
        Machine("none", "no driver: the message says what to install", no_driver()),
        at_home(
            "not-root",
            "a user who may write at home alone",
            wrap=found.stranger,
            prepare=_give_away,
            missing=no_pypi or _no_stranger(found),
        ),
        read_only_home(found, at_home("read-only-home", "nothing can be written at home")),
        at_home(
            "odd-paths",
            "spaces and letters beyond ASCII in home, TMPDIR and the scene's path",
            *ten_steps("{folder}/a hôme/スプラット"),
            home="a hôme",
            temporary="a hôme/tmp é",
        ),
        full_temporary(
            found,
            at_home("full-tmp", "no space left in TMPDIR: training beside it, and one line for training on it", *made),
        ),
        at_home(
            "lang-c",
            "LANG=C, and a scene with letters beyond ASCII in its path",
            *ten_steps("{folder}/made/é"),
            variables=(("LANG", "C"), *built),
        ),
        at_home(
            "ascii",
            "LC_ALL=C with Python kept from making UTF-8 of it",
            *made,
            variables=(("LC_ALL", "C"), ("PYTHONUTF8", "0"), ("PYTHONCOERCECLOCALE", "0"), *built),
        ),
    ]


def emulated(found: Found, missing: str) -> Machine:
    """A machine with an emulated processor without AVX-512, for which PyPI's PoCL builds kernels.

    missing: the reason why PyPI's PoCL is missing, or empty.
    """

    def write_interpreter(folder: Path) -> None:
        # without features of Haswell that QEMU cannot emulate, which would cause a warning in every process
        processor = "Haswell,-pcid,-x2apic,-tsc-deadline,-hle,-invpcid,-rtm"
        command = shlex.join([found.qemu, "-cpu", processor, PYTHON])
        script = folder / "python"
        script.write_text(f'#!/bin/sh\nexec {command} "$@"\n')
        script.chmod(0o755)

    steps = tuple(
        replace(step, limit=EMULATED * step.limit, command=("{folder}/python", *step.command[1:]))
        for step in (short_test(), *ten_steps("{folder}/made"))
    )
    return Machine(
        "pypi-pocl-haswell",
        "what pip brings, in 16 lanes on an emulated processor without AVX-512",
        steps,
        pypi=True,
        variables=(
            ("PYTHONPATH", str(HOOKS)),
            ("CLSPLAT_INTERPRETER", "{folder}/python"),
            ("CLSPLAT_SHAPE", "16x1"),
            # np.fmax of NumPy 2.4 crashes QEMU 7.2 in its loops for AVX2; this does not affect kernels
            ("NPY_DISABLE_CPU_FEATURES", "X86_V3"),
        ),
        missing=missing or ("" if found.qemu else "qemu-x86_64 is missing (Debian's qemu-user)"),
        prepare=write_interpreter,
    )


def no_driver() -> tuple[Step, ...]:
    """The steps of a machine without drivers: each verb that needs a device must say what to install."""
    install = "pip install 'pyopencl[pocl]'"
    scene, train = ten_steps("{folder}/made")
    return (
        Step("devices", (PYTHON, "-m", "clsplat", "devices"), TRAIN_LIMIT, status=2, says=install),
        scene,
        replace(train, status=2, says=install),
        Step("demo", (PYTHON, "-m", "clsplat", "demo", "-o", "{folder}/demo"), TRAIN_LIMIT, status=2, says=install),
    )


def read_only_home(found: Found, machine: Machine) -> Machine:
    """The machine with its home on a read-only mount, to which root cannot write either.

    If mounts are not allowed, the home cannot be created instead.
    """
    if found.mounts:
        script = 'mount --bind "$1" "$1" && mount -o remount,ro,bind "$1" && shift && exec "$@"'
        return replace(machine, wrap=(*found.mounts, "sh", "-c", script, "sh", "{folder}/home"))

    def write_file(folder: Path) -> None:
        (folder / "file").touch()

    return replace(machine, prepare=write_file, variables=(("HOME", "{folder}/file/home"),))


def full_temporary(found: Found, machine: Machine) -> Machine:
    """The machine with a full TMPDIR, with a training that writes elsewhere and one that writes into TMPDIR."""
    script = 'mount -t tmpfs -o size=64k none "$1" && { cat /dev/zero >"$1/filler" 2>/dev/null; shift; exec "$@"; }'
    scene, train = ten_steps("{folder}/made")
    command = tuple("{folder}/tmp/run" if word == "{folder}/made/run" else word for word in train.command)
    on_it = Step("on it", command, TRAIN_LIMIT, status=1, says="the disk is full")
    return replace(
        machine,
        wrap=(*found.mounts, "sh", "-c", script, "sh", "{folder}/tmp"),
        steps=(short_test(), scene, train, on_it),
        missing=machine.missing or ("" if found.mounts else "mounts are not allowed here"),
    )


def _is_root() -> bool:
    return os.name == "posix" and os.geteuid() == 0


def _mounts() -> tuple[str, ...]:
    command = ("unshare", "--mount") if _is_root() else ("unshare", "--map-root-user", "--mount")
    return command if _works((*command, "mount", "-t", "tmpfs", "none", tempfile.gettempdir())) else ()


def _stranger() -> tuple[str, ...]:
    """Command prefix for the user nobody; empty if not allowed. If the checkout or Python is in root's home, the user
    may read everything, so that nothing has to be copied."""
    nobody = ("setpriv", "--reuid=65534", "--regid=65534", "--clear-groups")
    reading = ("--inh-caps=+dac_read_search", "--ambient-caps=+dac_read_search")
    # also test a child process: setpriv itself can follow paths that its command cannot
    code = "import clsplat.cli.main, pyopencl, subprocess, sys; subprocess.check_call([sys.executable, '-V'])"
    for command in (nobody, (*nobody, *reading)):
        if _is_root() and _works((*command, PYTHON, "-c", code)):
            return command
    return ()


def _no_stranger(found: Found) -> str:
    if found.stranger:
        return ""
    return "another user cannot read this" if found.root else "this user is not root, so that every row is that"


def _give_away(folder: Path) -> None:
    for name in ("home", "tmp", "made"):
        os.chown(folder / name, 65534, 65534)


def _works(command: Sequence[str]) -> bool:
    if shutil.which(command[0]) is None:
        return False
    return subprocess.run(command, cwd=ROOT, capture_output=True, check=False).returncode == 0


def main(arguments: Sequence[str]) -> int:
    """Run the table."""
    summary, _, details = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=summary, epilog=details, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--list", action="store_true", help="print the names and what each is")
    parser.add_argument("--only", default="", metavar="NAME,...", help="these alone")
    parser.add_argument("--full", default="", metavar="NAME,...", help="tools/test too on these")
    parser.add_argument("--short", action="store_true", help="fewer machines, and smoke tests on few of them")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="so many at once")
    parser.add_argument("--markdown", action="store_true", help="print the table as Markdown")
    given = parser.parse_args(arguments)
    rows = machines(look())
    try:
        wanted, whole = (_named(rows, flag, text) for flag, text in (("--only", given.only), ("--full", given.full)))
    except ValueError as error:
        parser.error(str(error))
    if given.jobs < 1:
        parser.error(f"--jobs {given.jobs}: expected at least 1")
    rows = [row for row in rows if not wanted or row.name in wanted]
    rows = [replace(row, steps=(*row.steps, full())) if row.name in whole else row for row in rows]
    if given.short:
        left_out = set(IN_ALL) - wanted - whole
        rows = [shortened(row) for row in rows if row.name not in left_out]
    if given.list:
        for row in rows:
            print(f"{row.name}: {row.purpose}" + (f" (not run: {row.missing})" if row.missing else ""))
        return 0
    return run_all(rows, jobs=given.jobs, markdown=given.markdown)


def shortened(machine: Machine) -> Machine:
    """The machine with few smoke tests. Those of single kernels are left out, as the self-test has run these kernels,
    and all on machines that are not in SHORT_SMOKE."""
    few = (smoke(stages=False),) if machine.name in SHORT_SMOKE else ()
    steps = [(few if step.name == SMOKE else (step,)) for step in machine.steps]
    return replace(machine, steps=tuple(step for each in steps for step in each))


def _named(rows: Sequence[Machine], flag: str, text: str) -> set[str]:
    names = {row.name for row in rows}
    wanted = {name for name in text.split(",") if name}
    if unknown := wanted - names:
        raise ValueError(f"{flag} {','.join(sorted(unknown))}: no such machine; there are {', '.join(sorted(names))}")
    return wanted


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
