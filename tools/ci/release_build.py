# SPDX-License-Identifier: Apache-2.0
"""Builds the sdist and the wheel, compares them with git's files, and tries each in an empty environment.

`tools/release --build` runs this in the checkout's environment with the extra `release`. To try built files, any Python
without further packages is enough:

    python3.13 tools/ci/release_build.py dist/clsplat-0.1.0*
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import zipfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from environment import python_of
from release_checks import bundled, named, project

DEMO_STEPS = 60
"""Training steps of the demo that an installed package is tried with: enough for a model and its renders."""
MADE_BY_BUILD = {"PKG-INFO"}
"""Files of the sdist that the build adds."""
CONTENT_CHECKS = {"twine": ("check", "--strict"), "check_wheel_contents": ()}
"""Modules that check the built files, with their arguments."""


def build(root: Path, output: Path) -> list[Path]:
    """The sdist and the wheel, built from the checkout into a folder. Exits if a build fails."""
    output.mkdir(parents=True, exist_ok=True)
    _run([sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-t", "wheel", "-d", str(output)], root)
    stem = f"clsplat-{project(root)['version']}"
    return [output / f"{stem}.tar.gz", output / f"{stem}-py3-none-any.whl"]


def content_problems(root: Path, sdist: Path, wheel: Path) -> list[str]:
    """Return messages about files that an sdist or wheel lacks or has in excess of git's.

    A further message says if a wheel that is built from the sdist has other bytes than `wheel`.
    """
    files = set(bundled(root))
    in_wheel = {
        name if name.startswith("clsplat/") else f"clsplat/{name}"
        for name in files
        if name.startswith(("clsplat/", "kernels/"))
    }
    problems = differences("sdist", sdist_names(sdist) - MADE_BY_BUILD, files)
    problems += differences("wheel", wheel_names(wheel), in_wheel)
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(sdist) as archive:
            archive.extraction_filter = getattr(tarfile, "data_filter", None)  # Python 3.11.3 and older have none
            archive.extractall(folder)  # noqa: S202  # an archive of our own files
        (unpacked,) = Path(folder).iterdir()
        again = Path(folder) / "again"
        _run([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(again)], unpacked)
        if (again / wheel.name).read_bytes() != wheel.read_bytes():
            problems.append("the wheel built from the sdist has other bytes than the one built from the checkout")
    return problems


def differences(title: str, found: set[str], expected: set[str]) -> list[str]:
    """Return messages about files that a built file lacks, and about files in it that git does not have.

    title: "sdist" or "wheel".
    """
    missing, more = sorted(expected - found), sorted(found - expected)
    return [
        *([f"{title}: without {named(missing)}, which git has"] if missing else []),
        *(
            [f"{title}: with {named(more)}, which git does not have; remove what the build must not take"]
            if more
            else []
        ),
    ]


def sdist_names(path: Path) -> set[str]:
    """Names of the files of an sdist, below its one folder."""
    with tarfile.open(path) as archive:
        return {member.name.partition("/")[2] for member in archive.getmembers() if member.isfile()}


def wheel_names(path: Path) -> set[str]:
    """Names of the files of a wheel, without its metadata."""
    with zipfile.ZipFile(path) as archive:
        return {name for name in archive.namelist() if ".dist-info/" not in name and not name.endswith("/")}


def check_contents(root: Path, sdist: Path, wheel: Path) -> None:
    """Exit unless the built files hold what git holds, and twine and check-wheel-contents accept them."""
    problems = content_problems(root, sdist, wheel)
    if problems:
        sys.exit("\n".join(f"tools/release: {problem}" for problem in problems))
    print(
        f"contents   {len(bundled(root))} files of git in the sdist, {len(wheel_names(wheel))} in the wheel", flush=True
    )
    for module, words in CONTENT_CHECKS.items():
        files = [str(wheel)] if module == "check_wheel_contents" else [str(sdist), str(wheel)]
        _run([sys.executable, "-m", module, *words, *files], root)
        print(f"accepted   by {module.replace('_', '-')}", flush=True)
    for path in (sdist, wheel):
        print(f"sha256     {hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}", flush=True)


def try_out(package: Path, python: str) -> str:
    """Install a built file into a new virtual environment, list devices, and run the demo there.

    Returns a line with the version of Python and the seconds. Exits if a command fails.

    package: the sdist or the wheel. python: path or name of the interpreter.
    """
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _run([python, "-m", "venv", str(folder / "venv")], folder)
        inside = str(python_of(folder / "venv"))
        _run([inside, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", str(package)], folder)
        installed = time.monotonic()
        _run([inside, "-m", "clsplat", "--version"], folder)
        _run([inside, "-m", "clsplat", "devices"], folder)
        _run([inside, "-m", "clsplat", "demo", "-o", str(folder / "demo"), "--iterations", str(DEMO_STEPS)], folder)
        if not list((folder / "demo").rglob("model.ply")):
            sys.exit(f"tools/release: the demo of {package.name} wrote no model.ply")
        version = _output([inside, "-c", "import platform; print(platform.python_version())"])
    seconds = time.monotonic() - begun
    return f"{package.name}: Python {version}, installed in {installed - begun:.0f} s, all in {seconds:.0f} s"


def interpreters(asked: list[str]) -> list[str]:
    """Return the interpreters asked for; if none, the running one. Raises ValueError if a program is missing."""
    for name in asked:
        if shutil.which(name) is None:
            raise ValueError(f"--python {name}: no such program, expected a Python such as python3.12")
    return asked or [sys.executable]


def _environment() -> dict[str, str]:
    """Variables without those that lead Python or the tests of this checkout to other files."""
    ours = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    return {name: text for name, text in os.environ.items() if name not in ours and not name.startswith("CLSPLAT_")}


def _run(command: list[str], folder: Path) -> None:
    result = subprocess.run(command, cwd=folder, env=_environment(), stdin=subprocess.DEVNULL, check=False)
    if result.returncode != 0:
        sys.exit(f"tools/release: status {result.returncode} of {' '.join(command)}, see above")


def _output(command: list[str]) -> str:
    return subprocess.run(command, env=_environment(), capture_output=True, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Install built files into empty environments, and run the demo.")
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="an sdist or a wheel")
    for file in parser.parse_args().files:
        if not file.is_file():
            parser.error(f"{file}: no such file, expected an sdist or a wheel of dist/")
        print(try_out(file.resolve(), sys.executable), flush=True)
