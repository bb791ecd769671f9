# SPDX-License-Identifier: Apache-2.0
"""Simulated machines of `machines.py`: their steps, how these are run, and the table of the results."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from processor import processor

from clsplat.progress import aligned

ROOT = Path(__file__).resolve().parents[2]
HOOKS = ROOT / "tools" / "ci" / "hooks"
TAIL = 25
"""Number of last lines of a failed step's output that are printed."""


@dataclass(frozen=True)
class Step:
    """A command that a machine runs. limit: its time limit in seconds. status: the expected exit status.

    says: text that the last line on standard error must contain.
    without: text that the output must not contain.
    """

    name: str
    command: tuple[str, ...]
    limit: float
    status: int = 0
    says: str = ""
    without: str = "Traceback"


Drivers = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Machine:
    """A row of the table.

    drivers: names and contents of the .icd files.
    pypi: True to keep PyPI's PoCL visible.
    variables: environment variables and their values.
    wrap: words before each command.
    missing: the reason why the machine cannot run, or empty.
    prepare: called with the machine's folder before the first step.
    home, temporary: HOME and TMPDIR, relative to the machine's folder or absolute.
    """

    name: str
    purpose: str
    steps: tuple[Step, ...] = ()
    drivers: Drivers = ()
    pypi: bool = False
    variables: tuple[tuple[str, str], ...] = ()
    wrap: tuple[str, ...] = ()
    missing: str = ""
    prepare: Callable[[Path], None] = field(default=lambda folder: None)
    home: str = "home"
    temporary: str = "tmp"


@dataclass
class Result:
    """The outcome of a machine: seconds of each step that passed, and the problem, if any."""

    machine: Machine
    seconds: dict[str, float] = field(default_factory=dict)
    trouble: str = ""
    output: str = ""

    @property
    def words(self) -> str:
        """The result, as text for the table."""
        if self.machine.missing:
            return f"not run: {self.machine.missing}"
        return f"FAILED: {self.trouble}" if self.trouble else "passed"


def environment_of(machine: Machine, folder: Path) -> dict[str, str]:
    """All environment variables of a machine. Only PATH is inherited."""
    variables = {
        "PATH": os.environ.get("PATH", os.defpath),
        "LANG": "C.UTF-8",
        "HOME": str(folder / machine.home),
        "TMPDIR": str(folder / machine.temporary),
        "OCL_ICD_VENDORS": str(folder / "drivers"),
        "PYTHONDONTWRITEBYTECODE": "1",  # on some machines the checkout belongs to another user
        "RUSTICL_ENABLE": "llvmpipe",
    }
    if not machine.pypi:
        variables.update(PYTHONPATH=str(HOOKS), CLSPLAT_WITHOUT_PYPI_POCL=str(folder / "no-drivers"))
    return variables | {name: value.replace("{folder}", str(folder)) for name, value in machine.variables}


def run_machine(machine: Machine, show: Callable[[str], None] = print) -> Result:
    """Run a machine's steps up to the first that fails."""
    result = Result(machine)
    if machine.missing:
        return result
    with tempfile.TemporaryDirectory(prefix="clsplat-machine-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        folder.chmod(0o755)  # another user's home may be in it
        for part in ("drivers", "no-drivers", "made"):
            (folder / part).mkdir()
        for driver, library in machine.drivers:
            (folder / "drivers" / f"{driver}.icd").write_text(f"{library}\n")
        for part in (machine.home, machine.temporary):
            (folder / part).mkdir(parents=True, exist_ok=True)
        machine.prepare(folder)
        environment = environment_of(machine, folder)
        for step in machine.steps:
            start = time.monotonic()
            result.trouble, result.output = run_step(step, machine.wrap, environment, folder)
            seconds = time.monotonic() - start
            if result.trouble:
                result.trouble = f"{step.name}: {result.trouble}"
                break
            result.seconds[step.name] = seconds
            show(f"{machine.name}: {step.name}, {seconds:.0f} s")
    return result


def run_step(step: Step, wrap: Sequence[str], environment: dict[str, str], folder: Path) -> tuple[str, str]:
    """Run a step until its end or time limit. Returns the problem, if any, and the output."""
    command = [word.replace("{folder}", str(folder)) for word in (*wrap, *step.command)]
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        child = subprocess.Popen(
            command,
            cwd=ROOT,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=errors,
            start_new_session=True,
        )
        _RUNNING.add(child)
        try:
            status = child.wait(step.limit)
        except subprocess.TimeoutExpired:
            status = None
        finally:
            _end(child)
            _RUNNING.discard(child)
        texts = []
        for stream in (output, errors):
            stream.seek(0)
            texts.append(stream.read().decode(errors="replace"))
    return wrong(step, status, texts[1], "".join(texts)), "".join(texts)


_RUNNING: set[subprocess.Popen[bytes]] = set()
"""Child processes to end on Ctrl-C, which the terminal sends only to this process group."""


def wrong(step: Step, status: int | None, errors: str, output: str) -> str:
    """How a step's end differs from the expected end, or empty. status: None if the step did not end."""
    if status is None:
        return f"did not end within {step.limit:g} s"
    if status != step.status:
        return f"exit status {status}, expected {step.status}"
    lines = errors.strip().splitlines()
    if step.says and not (lines and step.says in lines[-1]):
        return f"its last line is {lines[-1] if lines else 'empty'!r}, expected {step.says!r} in it"
    if step.without in output:
        return f"printed {step.without!r}, expected an output without it"
    return ""


def _end(child: subprocess.Popen[bytes]) -> None:
    """End all processes of a step, which are a process group."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL)
    child.wait()


def table(results: Sequence[Result], *, markdown: bool = False) -> str:
    """The table of all rows, as plain text or as Markdown."""
    rows = [("machine", "what it is", "seconds", "result")]
    for result in results:
        times = ", ".join(f"{name} {seconds:.0f}" for name, seconds in result.seconds.items())
        rows.append((result.machine.name, result.machine.purpose, times, result.words))
    if markdown:
        rows[1:] = [(f"`{row[0]}`", *row[1:]) for row in rows[1:]]
        rows.insert(1, ("---",) * 4)
        return "\n".join(f"| {' | '.join(row)} |" for row in rows)
    return "\n".join(aligned(rows, left=range(4)))


def run_all(rows: Sequence[Machine], *, jobs: int = 1, markdown: bool = False) -> int:
    """Run machines, print the result of each, and the table. Returns the exit status."""

    def show(text: str) -> None:
        print(text, flush=True)

    def run(machine: Machine) -> Result:
        result = run_machine(machine, show)
        if result.trouble:
            tail = "".join(f"    {line}\n" for line in result.output.splitlines()[-TAIL:])
            show(f"{machine.name}: {result.words}\n{tail}")
        return result

    start = time.monotonic()
    with ThreadPoolExecutor(jobs) as pool:
        try:
            results = list(pool.map(run, rows))
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            for child in tuple(_RUNNING):
                _end(child)
            return 130
    failed = [result.machine.name for result in results if result.trouble]
    missing = sum(bool(result.machine.missing) for result in results)
    print(f"\n{table(results, markdown=markdown)}\n")
    print(
        f"{len(rows)} machines on {processor()}, {os.cpu_count()} cores: {len(rows) - len(failed) - missing} passed, "
        f"{len(failed)} failed, {missing} not run, {time.monotonic() - start:.0f} s"
    )
    return 1 if failed else 0
