# SPDX-License-Identifier: Apache-2.0
"""The process of one attempt: it claims the task, runs the command, and writes the command's output to the task's log.

It reads an `Attempt` as a line of JSON from standard input, and writes an `Outcome` as a line of JSON to standard
output. The process that started it keeps standard input open. When that process ends, for whatever reason, the command
is ended too, so that no command runs without a dispatcher or worker.
"""

from __future__ import annotations

import ctypes
import errno
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import IO

from clsplat.errors import examples, reason_of
from clsplat.jobs.claims import HeldClaims
from clsplat.jobs.task import ATTEMPT_PREFIX, MARK_FILE_NAME, Attempt, Outcome, last_line, log_path
from clsplat.process import apart, module_command, terminable
from clsplat.version import package_version

END_SECONDS = 60.0
"""Seconds that a command has to end by itself, with a checkpoint, before it is killed."""
_DISK_FULL_REASONS = tuple(
    text for number in (errno.ENOSPC, errno.EDQUOT) for text in (reason_of(OSError(number, "")), os.strerror(number))
)
_PR_SET_PDEATHSIG = 1


def run_attempt(attempt: Attempt, ended: threading.Event) -> Outcome:
    """Claim the task, and run its command once. ended: event that ends the command when it is set."""
    folder, host = Path(attempt.folder), socket.gethostname()
    if reason := unfit_reason(attempt):
        return Outcome(attempt.name, "unfit", reason=reason, worker=host)
    claims = HeldClaims()
    try:
        try:
            if not claims.take(folder / attempt.name):
                return Outcome(attempt.name, "claimed", worker=host)
            status = _run_command(attempt, ended)
        except OSError as error:
            reason = f"cannot go on: {error.filename or folder}: {reason_of(error)}"
            return Outcome(attempt.name, "unfit", reason=reason, worker=host)
    finally:
        claims.close()
    if status and (reason := unfit_reason(attempt) or _disk_full(log_path(folder, attempt.name))):
        return Outcome(attempt.name, "unfit", status, reason, host)
    return Outcome(attempt.name, "ended", status, worker=host)


def unfit_reason(attempt: Attempt) -> str:
    """Why this worker cannot run the attempt: it has another version, or does not see the files; empty if it can."""
    if attempt.version != package_version():
        return f"has clsplat {package_version()}, expected {attempt.version} like the dispatcher"
    if unseen := [path for path in attempt.needs if not Path(path).exists()]:
        return f"does not see {examples(unseen)}, expected the same paths as on the dispatcher's machine"
    mark = Path(attempt.folder) / MARK_FILE_NAME
    try:
        same = mark.read_text(encoding="ascii", errors="replace") == attempt.mark
    except OSError:
        return f"does not see {attempt.folder}, expected the same paths as on the dispatcher's machine"
    return "" if same else f"sees another folder as {attempt.folder} than the dispatcher, expected a shared folder"


def _disk_full(log: Path) -> str:
    """Why this worker cannot run tasks if the log's last line says that a disk is full, else an empty string."""
    line = last_line(log)
    return f"cannot go on: {line}" if any(reason in line for reason in _DISK_FULL_REASONS) else ""


def _run_command(attempt: Attempt, ended: threading.Event) -> int:
    """Run the command, and return its exit status. Raises OSError if the command or its log cannot be opened."""
    words = list(attempt.command)
    if words[0] == "clsplat":
        words = module_command("clsplat", *words[1:])
    with log_path(attempt.folder, attempt.name).open("ab") as log:
        now = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime())
        head = f"{ATTEMPT_PREFIX}{now}, {socket.gethostname()}, process {os.getpid()}: {' '.join(attempt.command)}\n"
        log.write(head.encode())
        log.flush()
        try:
            process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                preexec_fn=_killed_with_parent(),  # noqa: PLW1509  # calls one C function that is loaded already
                **apart(),
            )
        except FileNotFoundError as error:
            log.write(f"{error.filename}: no such command\n".encode())
            return 2
        threading.Thread(target=_end_at, args=(ended, process), daemon=True).start()
        try:
            with terminable():
                return process.wait()
        except KeyboardInterrupt:
            end_command(process)
            return process.returncode


def _end_at(ended: threading.Event, process: subprocess.Popen[bytes]) -> None:
    ended.wait()
    end_command(process)


def end_command(process: subprocess.Popen[bytes]) -> None:
    """Ask a command to end (SIGTERM; Ctrl-Break on Windows). Kill it and its processes after END_SECONDS."""
    with suppress(OSError):
        if sys.platform == "win32":
            process.send_signal(signal.CTRL_BREAK_EVENT)
        else:
            process.terminate()
    try:
        process.wait(END_SECONDS)
    except subprocess.TimeoutExpired:
        with suppress(OSError):
            if sys.platform == "win32":
                process.kill()
            else:
                os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _killed_with_parent() -> Callable[[], None] | None:
    """On Linux, a function that a new process calls, so that the system kills it when its parent is killed.

    On other systems None: a command whose attempt is killed goes on there until it ends by itself.
    """
    if not sys.platform.startswith("linux"):
        return None
    prctl = ctypes.CDLL(None).prctl
    number = int(signal.SIGKILL)

    def arrange() -> None:
        prctl(_PR_SET_PDEATHSIG, number)

    return arrange


def _watch(stream: IO[bytes], ended: threading.Event) -> None:
    while stream.read(1 << 10):
        pass
    ended.set()


def main() -> int:
    """Run the attempt that standard input names, and print its outcome. Returns the exit status."""
    attempt = Attempt(**json.loads(sys.stdin.buffer.readline()))
    ended = threading.Event()
    threading.Thread(target=_watch, args=(sys.stdin.buffer, ended), daemon=True).start()
    outcome = run_attempt(attempt, ended)
    with suppress(OSError):  # the process that started this one has ended
        print(json.dumps(asdict(outcome)), flush=True)
    os._exit(0)  # a thread still reads standard input, which would hold up the interpreter's end


if __name__ == "__main__":
    sys.exit(main())
