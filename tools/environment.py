# SPDX-License-Identifier: Apache-2.0
"""Make the checkout's own environment, `.venv`, with clsplat installed in it; `tools/demo` and `tools/test` use it.

It needs only Python's standard library and a package index that pip can reach. Run as a script, it installs the extras
named as arguments and prints the path of the environment's Python.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ENVIRONMENT = ROOT / ".venv"
OLDEST = (3, 10)
EDITABLE = str(ROOT).isascii()
"""True if the install may be editable. Before 3.13, Python reads the path of an editable install in the locale's
encoding, though it is in UTF-8, and may fail to start. If False, `run` puts the checkout first in PYTHONPATH."""


def python_of(environment: Path) -> Path:
    """Path of a virtual environment's interpreter."""
    return environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def set_up(extras: tuple[str, ...] = ()) -> Path:
    """Create `.venv` if it is missing, install clsplat in it (editable if possible), and return its Python.

    Installs again only if pyproject.toml has changed, the checkout has moved, or an extra is new. Exits with a message
    of one line if this Python is too old or pip fails.
    """
    if sys.version_info < OLDEST:
        found = ".".join(map(str, sys.version_info[:3]))
        sys.exit(f"{sys.argv[0]}: this is Python {found}, expected {'.'.join(map(str, OLDEST))} or later")
    python = python_of(ENVIRONMENT)
    if not _runs(python):
        print(f"making {ENVIRONMENT}", file=sys.stderr, flush=True)
        # --clear: an existing environment is broken, for example by an interruption or an upgrade of Python
        if _call([sys.executable, "-m", "venv", "--clear", str(ENVIRONMENT)]) != 0:
            shutil.rmtree(ENVIRONMENT, ignore_errors=True)
            sys.exit(f"{sys.argv[0]}: {sys.executable} -m venv failed; on Debian and Ubuntu, install python3-venv")

    stamp = ENVIRONMENT / "clsplat-installed"
    state = hashlib.sha256((ROOT / "pyproject.toml").read_bytes() + os.fsencode(ROOT)).hexdigest()
    lines = stamp.read_text("utf-8").splitlines() if stamp.exists() else []
    installed = set(lines[1:]) if lines[:1] == [state] else None
    if installed is None or not installed.issuperset(extras):
        wanted = sorted({*extras, *(installed or ())})
        target = f"{ROOT}[{','.join(wanted)}]" if wanted else str(ROOT)
        print("installing clsplat and what it needs (several hundred MB the first time)", file=sys.stderr, flush=True)
        stamp.unlink(missing_ok=True)
        command = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        if _call([*command, *(["--editable"] if EDITABLE else []), target]) != 0:
            sys.exit(f"{sys.argv[0]}: pip could not install clsplat, see above; is the package index reachable?")
        stamp.write_text("\n".join([state, *wanted]) + "\n", "utf-8")
    return python


def run(command: list[str]) -> int:
    """Run a command until it ends, and return its exit status. Ctrl-C interrupts the command, not the waiting."""
    found = [] if EDITABLE else [str(ROOT)]
    path = os.pathsep.join([*found, *filter(None, [os.environ.get("PYTHONPATH")])])
    process = subprocess.Popen(command, env={**os.environ, **({"PYTHONPATH": path} if path else {})})
    while True:
        try:
            status = process.wait()
        except KeyboardInterrupt:
            continue  # the terminal has sent Ctrl-C to the command too, which handles it
        return status if status >= 0 else 128 - status


def _runs(python: Path) -> bool:
    return python.exists() and _call([str(python), "-c", "import pip"], quiet=True) == 0


def _call(command: list[str], *, quiet: bool = False) -> int:
    stream = subprocess.DEVNULL if quiet else sys.stderr
    # venv and pip write paths in UTF-8, and fail if the locale has another encoding and a path is not ASCII
    utf8 = {} if sys.getfilesystemencoding() == "utf-8" else {"PYTHONUTF8": "1"}
    variables = {**os.environ, **utf8}
    return subprocess.run(
        command, stdin=subprocess.DEVNULL, stdout=stream, stderr=stream, env=variables, check=False
    ).returncode


if __name__ == "__main__":
    if isinstance(sys.stdout, io.TextIOWrapper):
        encoding, errors = sys.getfilesystemencoding(), sys.getfilesystemencodeerrors()  # as for paths
        sys.stdout.reconfigure(encoding=encoding, errors=errors)
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("extras", nargs="*", metavar="EXTRA", help="extras of pyproject.toml: test, dev, docs, ...")
    print(set_up(tuple(parser.parse_args().extras)))
