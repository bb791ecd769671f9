#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Test how every verb ends after a signal, on a full disk, with a closed stream, or next to another process.

    python tools/stress/interruptions.py [--verbs train,eval] [--events SIGINT,2>&-] [--markdown]

Each verb runs in a process of its own, on a small scene that is made beforehand. --markdown prints the tables that
docs/interruptions.md summarises. A full disk is a small file system, if this user may mount one, or otherwise a limit
of the size of files. A verb that writes no files prints to /dev/full. The exit status is 1 if a process ends with a
traceback or by a signal, or does not end. CLSPLAT_TRUST_DRIVER=1 saves the time of self-tests.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))

from tiny import write_scene

LONG, SHORT = 100_000, 20
DEADLINE = 300.0
"""Seconds that a process may take to end."""
MARKER = ".at-work"
FULL = 48 << 10
"""Number of bytes that still fit on a full disk."""
TRAINING = (
    *("--sh-degree", "0", "--density.every", "0", "--warmup", ""),
    *("--checkpoint-every", "0", "--no-report"),
)


@dataclass(frozen=True)
class Verb:
    """A call of a verb.

    words: its command line, with {scene}, {photos}, {run}, {other}, {model} and {out}, the folder that it writes to.
    ready: event that shows that the verb is at work. /PATTERN: a file below {out} matches it. !NAME: Python has raised
        this audit event. A name of a module: the module is imported.
    writes: True if it writes files.
    """

    name: str
    words: str
    ready: str
    writes: bool = True

    @property
    def in_a_run(self) -> bool:
        """True if it works in a copy of the finished run."""
        return "{out}/run" in self.words and self.name != "train"


TRAIN = " ".join(["train {scene} -o {out}/run --iterations", str(LONG), *(word or "''" for word in TRAINING)])
VERBS = (
    Verb("devices", "devices", "pyopencl", writes=False),
    Verb("demo", "demo -o {out}/demo --iterations 100", "/demo/photos"),
    Verb("capture", "capture {photos} -o {out}/shot --iterations 100", "/shot/.scene.*/database.db"),
    Verb("sfm", "sfm {photos} -o {out}/scene", "/.scene.*/database.db"),
    Verb("train", TRAIN, "/run/metrics.jsonl"),
    Verb("eval", "eval {out}/run", "clsplat.progress"),
    Verb("render", "render {model} --cameras {scene} --path turntable --count 200 -o {out}/a.####.png", "/a.0002.png"),
    Verb("view", "view {model} --port 0", "!socket.bind", writes=False),
    Verb("report", "report {out}/run", "clsplat.report.page"),
    Verb("compare", "compare {run} {other} -o {out}/a.html", "clsplat.report.compare"),
    Verb("convert", "convert {model} {out}/a.sog", "clsplat.models.difference"),
    Verb("info", "info {model}", "clsplat.models.info", writes=False),
    Verb("bench", "bench --gaussians 5000 --size 320x240 --repeat 3", "clsplat.bench.settings", writes=False),
    Verb("tune", "tune", "clsplat.bench.shapes", writes=False),
    Verb("selftest", "selftest", "!subprocess.Popen", writes=False),
    Verb("doctor", "doctor", "!subprocess.Popen", writes=False),
)
WATCHED = """
import os, sys
marker, wanted = sys.argv[1:3]
sys.argv[:3] = ["clsplat"]

def hook(event, arguments):
    if event == wanted[1:] if wanted[0] == "!" else (event, *arguments[:1]) == ("import", wanted):
        os.close(os.open(marker, os.O_CREAT | os.O_WRONLY))

sys.addaudithook(hook)
from clsplat.__main__ import main
sys.exit(main())
"""
"""Program that runs the command line, and creates a marker file when it is at work."""
SIGNALS = {"SIGINT": 1, "SIGINT twice": 2, "SIGTERM": 1, "SIGHUP": 1}
STREAMS = (">&-", "2>&-", "| head -c 0", "2>&1 | head -c 0")
TITLES = {
    "SIGINT": "Ctrl-C (SIGINT) in the middle of the work",
    "SIGINT twice": "Ctrl-C twice, a twentieth of a second apart",
    "SIGTERM": "SIGTERM, as managers of jobs send it",
    "SIGHUP": "SIGHUP, as when a terminal is closed",
    "full disk": "A full disk; where no file is written, standard output on one",
    ">&-": "Standard output closed: `>&-`",
    "2>&-": "Standard error closed: `2>&-`",
    "| head -c 0": "A reader of standard output that has gone: `| head -c 0`",
    "2>&1 | head -c 0": "A reader of both that has gone: `2>&1 | head -c 0`",
    "second process": "Another process at work in the same folder: a training in the run, else the same verb",
}
EVENTS = tuple(TITLES)


@dataclass
class Outcome:
    """How a process has ended.

    status: its exit status, None if it did not end.
    told: the last line that it printed.
    left: hidden files that it left behind.
    """

    verb: str
    event: str
    status: int | None
    told: str
    left: list[str]
    traceback: bool

    @property
    def sound(self) -> bool:
        return self.status is not None and self.status >= 0 and not self.traceback


class Bench:
    """A folder with the scenes, runs and models that the verbs need."""

    def __init__(self, folder: Path, verbs: Sequence[Verb]) -> None:
        self.folder = folder
        self.names = {name: str(folder / name) for name in ("scene", "photos", "run", "other")}
        self.names.update(model=str(folder / "run" / "model.ply"), cache=str(folder / "cache"))
        write_scene(folder / "scene")
        if any("{photos}" in verb.words for verb in verbs):
            from clsplat.demo.ray_caster import write_photos

            write_photos(folder / "photos", count=12, width=320, height=240)
        for name in ("run", "other"):
            self.call(["train", self.names["scene"], "-o", self.names[name], "--iterations", str(SHORT), *TRAINING])

    def call(self, words: Sequence[str]) -> None:
        """Run the command line to its end. Raises SystemExit if it fails."""
        done = subprocess.run(command(words), capture_output=True, text=True, timeout=DEADLINE, check=False)
        if done.returncode:
            raise SystemExit(f"{' '.join(words)}: {done.stderr}")

    def words(self, verb: Verb, out: Path, *, ends: bool = False) -> list[str]:
        """The verb's command line. For verbs that write into a run, copies the finished run into `out` first.

        ends: True for a short training that ends by itself, and so also writes the files of its end.
        """
        if verb.in_a_run:
            shutil.copytree(self.folder / "run", out / "run")
        words = verb.words.format(out=out, **self.names).split(" ")
        return [{"''": "", str(LONG): str(SHORT if ends else LONG)}.get(word, word) for word in words]


def command(words: Sequence[str], verb: Verb | None = None, marker: Path | None = None) -> list[str]:
    """Command line of a process. With `verb` and `marker`, the process creates the file `marker` when it is at work."""
    if verb is None or verb.ready.startswith("/"):
        return [sys.executable, "-m", "clsplat", *words]
    return [sys.executable, "-c", WATCHED, str(marker), verb.ready, *words]


def keep_apart(folder: Path) -> None:
    """Give child processes a cache of their own, because `tune` stores shapes in it that later calls would use.

    The caches of built kernels stay where they are.
    """
    before = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    os.environ.setdefault("POCL_CACHE_DIR", str(before / "pocl" / "kcache"))
    os.environ.setdefault("CLSPLAT_BINARIES", str(before / "clsplat" / "binaries"))
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")


@contextmanager
def fresh(folder: Path) -> Iterator[Path]:
    """A context manager that makes a new folder below `folder`, and removes it in the end."""
    out = Path(tempfile.mkdtemp(prefix="out-", dir=folder))
    try:
        yield out
    finally:
        shutil.rmtree(out, ignore_errors=True)


@contextmanager
def full_disk(folder: Path, before: int) -> Iterator[tuple[Path, Callable[[], None] | None]]:
    """A context manager with a folder on a disk that has room for `before` + FULL bytes. It gives the folder and None.

    If no disk can be mounted, it gives an ordinary folder, and a function that limits the size of a child process's
    files.
    """
    with fresh(folder) as out:
        size = f"size={before + FULL + (64 << 10)}"
        mounted = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", size, "tmpfs", str(out)], capture_output=True, check=False
        )
        if mounted.returncode == 0:
            try:
                yield out, None
            finally:
                subprocess.run(["umount", "-l", str(out)], check=True)
            return

        def limit() -> None:
            import resource

            resource.setrlimit(resource.RLIMIT_FSIZE, (FULL, FULL))

        yield out, limit


def result_of(verb: Verb, event: str, done: tuple[int | None, str], out: Path, names: dict[str, str]) -> Outcome:
    """Outcome of a process that has ended.

    done: its exit status and its output.
    names: paths by name; in the outcome, the name replaces the path.
    """
    status, text = done
    lines = [line for line in text.splitlines() if line.strip()]
    told = lines[-1] if lines else ""
    for name, path in {"OUT": str(out), **{name.upper(): path for name, path in names.items()}}.items():
        told = told.replace(path, name)
    hidden = [path for path in out.rglob(".*") if path.name != MARKER]
    left = sorted(str(path.relative_to(out)) for path in hidden)
    return Outcome(verb.name, event, status, told, left, "Traceback (most recent call last)" in text)


def wait(process: subprocess.Popen[str]) -> tuple[int | None, str]:
    """Exit status and output of a process. The status is None if it did not end and was killed."""
    try:
        output, errors = process.communicate(timeout=DEADLINE)
    except subprocess.TimeoutExpired:
        process.kill()
        output, errors = process.communicate()
        return None, (output or "") + (errors or "")
    return process.returncode, (output or "") + (errors or "")


def wait_until_at_work(verb: Verb, process: subprocess.Popen[str], out: Path) -> bool:
    """True if the process is at work, False if it has ended before."""
    until = time.monotonic() + DEADLINE
    pattern = verb.ready[1:] if verb.ready.startswith("/") else MARKER
    while process.poll() is None and time.monotonic() < until:
        if any(out.glob(pattern)):
            return True
        time.sleep(0.02)
    return False


def start(verb: Verb, words: Sequence[str], out: Path, **options: object) -> subprocess.Popen[str]:
    """Start a process. Its output and errors are read, unless `options` redirect them."""
    streams: dict[str, object] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
    line = command(words, verb, out / MARKER)
    return subprocess.Popen(line, text=True, encoding="utf-8", errors="replace", **streams)  # type: ignore[call-overload, no-any-return]


def finish(verb: Verb, process: subprocess.Popen[str], out: Path) -> tuple[int | None, str]:
    """Wait for the process. A viewer is ended by Ctrl-C."""
    if verb.name == "view" and wait_until_at_work(verb, process, out):
        time.sleep(4.0)  # until its page is served
        process.send_signal(signal.SIGINT)
    return wait(process)


def signalled(bench: Bench, verb: Verb, event: str) -> Outcome:
    """Outcome of the verb if a signal interrupts its work."""
    with fresh(bench.folder) as out:
        process = start(verb, bench.words(verb, out), out)
        if not wait_until_at_work(verb, process, out):
            raise SystemExit(f"{verb.name}: has ended before it was at work: {wait(process)}")
        number = getattr(signal, event.partition(" ")[0])
        for index in range(SIGNALS[event]):
            time.sleep(0.05 * index)
            with suppress(ProcessLookupError):
                process.send_signal(number)
        found = result_of(verb, event, wait(process), out, bench.names)
    if found.status == -number:  # Python itself ends like this if Ctrl-C comes during its shutdown
        found.status = 128 + number
    return found


def on_a_full_disk(bench: Bench, verb: Verb) -> Outcome:
    """Outcome of the verb if its files, or its standard output if it writes none, are on a full disk."""
    if not verb.writes:
        with fresh(bench.folder) as out, open("/dev/full", "w") as full:
            process = start(verb, bench.words(verb, out), out, stdout=full)
            return result_of(verb, "full disk", finish(verb, process, out), out, bench.names)
    before = sum(path.stat().st_size + 4096 for path in (bench.folder / "run").rglob("*")) if verb.in_a_run else 0
    with full_disk(bench.folder, before) as (out, limit):
        words = bench.words(verb, out, ends=True)
        left = FULL // 4 if verb.ready.startswith("/") else 0  # so that these verbs fail in the middle of their work
        if limit is None:
            with suppress(OSError), open(out / "filler", "wb", buffering=0) as filler:
                filler.write(bytes(max(shutil.disk_usage(out).free - left, 0)))
        return result_of(verb, "full disk", wait(start(verb, words, out, preexec_fn=limit)), out, bench.names)


def with_a_stream(bench: Bench, verb: Verb, event: str) -> Outcome:
    """Outcome of the verb with a closed stream, or a pipe whose reader has gone, as from a shell."""
    with fresh(bench.folder) as out:
        words = bench.words(verb, out, ends=True)
        said = out / "said"
        line = '"$@" ' + {">&-": ">&- 2>said", "2>&-": ">said 2>&-"}.get(event, "")
        if event.endswith("head -c 0"):
            read, write = os.pipe()
            os.close(read)
            kept = {} if event.startswith("2>&1") else {"stderr": subprocess.PIPE}
            process = start(verb, words, out, **{"stdout": write, "stderr": write, **kept})
            os.close(write)
        else:
            call = command(words, verb, out / MARKER)
            process = subprocess.Popen(["sh", "-c", f"cd {out}; exec {line}", "sh", *call], text=True)
        status, text = finish(verb, process, out)
        text += said.read_text("utf-8", errors="replace") if said.exists() else ""
        return result_of(verb, event, (status, text), out, bench.names)


def beside_another(bench: Bench, verb: Verb) -> Outcome:
    """Outcome of the verb next to another process: a training in its run, or the same verb in the same folder."""
    with fresh(bench.folder) as out:
        words = bench.words(verb, out)
        first, ready = words, verb
        if verb.in_a_run:
            resumed = ["train", "-o", str(out / "run"), "--resume", "--iterations", str(LONG)]
            first, ready = resumed, Verb("train", TRAIN, "/run/.clsplat-lock")
        other = start(ready, first, out, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            wait_until_at_work(ready, other, out)
            (out / MARKER).unlink(missing_ok=True)
            done = finish(verb, start(verb, words, out), out)
        finally:
            other.kill()
            other.wait()
        found = result_of(verb, "second process", done, out, bench.names)
        found.told = found.told.replace(f"process {other.pid}", "process 123")
        found.left = []  # these files are the other process's
        return found


def outcome(bench: Bench, verb: Verb, event: str) -> Outcome:
    """Run the verb with this event, and return the outcome."""
    if event in SIGNALS:
        return signalled(bench, verb, event)
    if event == "full disk":
        return on_a_full_disk(bench, verb)
    if event in STREAMS:
        return with_a_stream(bench, verb, event)
    return beside_another(bench, verb)


def tables(outcomes: Sequence[Outcome]) -> str:
    """Markdown text with a table of the outcomes for each event."""
    text = []
    for event in dict.fromkeys(each.event for each in outcomes):
        text += [f"### {TITLES[event]}", "", "| verb | exit status | last line | left behind |", "|---|---|---|---|"]
        for each in (found for found in outcomes if found.event == event):
            status = "does not end" if each.status is None else str(each.status)
            told = f"`{each.told.replace('|', ' ')}`" if each.told else "nothing"
            told = "a traceback" if each.traceback else told
            text.append(
                f"| `{each.verb}` | {status} | {told} | {', '.join(f'`{name}`' for name in each.left) or '-'} |"
            )
        text.append("")
    return "\n".join(text)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the verbs with the events. Returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--verbs", help="such as train,eval; all if not given")
    parser.add_argument("--events", help=f"some of {', '.join(EVENTS)}; all if not given")
    parser.add_argument("--markdown", action="store_true", help="print tables, not lines")
    options = parser.parse_args(arguments)
    known = {verb.name: verb for verb in VERBS}
    names = options.verbs.split(",") if options.verbs else list(known)
    events = options.events.split(",") if options.events else list(EVENTS)
    for given, of in ((names, known), (events, EVENTS)):
        if unknown := [each for each in given if each not in of]:
            parser.error(f"{unknown[0]}: expected some of {', '.join(of)}")
    verbs = [known[name] for name in names]
    for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
        signal.signal(number, handler)  # after a shell's `&` or nohup, child processes would ignore these signals
    outcomes = []
    with tempfile.TemporaryDirectory(prefix="clsplat-interruptions-") as folder:
        keep_apart(Path(folder))
        bench = Bench(Path(folder), verbs)
        for event in events:
            for verb in verbs:
                found = outcome(bench, verb, event)
                outcomes.append(found)
                mark = "" if found.sound else "  <- expected an exit status without a traceback"
                print(f"{event}: {found.verb}: {found.status}: {found.told}{mark}", file=sys.stderr, flush=True)
    if options.markdown:
        print(tables(outcomes))
    return 0 if all(each.sound for each in outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
