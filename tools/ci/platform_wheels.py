#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Check that every package that clsplat needs has a wheel, for each system and Python that clsplat supports.

    .venv/bin/python tools/ci/platform_wheels.py                     # all systems of SYSTEM_TAGS, all Pythons
    .venv/bin/python tools/ci/platform_wheels.py --python 3.12 --extra video

uv resolves the requirements of pyproject.toml with the markers of the system asked about. Then pip, which evaluates
markers for this system only, has to find a wheel of each package in the version that uv chose. Needs the extra
`release`.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from release_checks import project

ROOT = Path(__file__).resolve().parents[2]
SYSTEM_TAGS = {
    "Linux, x86-64": (
        "x86_64-manylinux_2_28",
        ["manylinux_2_28_x86_64", "manylinux_2_17_x86_64", "manylinux2014_x86_64"],
    ),
    "Windows, x86-64": ("x86_64-pc-windows-msvc", ["win_amd64"]),
    "macOS 14, Apple silicon": ("aarch64-apple-darwin", [f"macosx_{major}_0_arm64" for major in (14, 13, 12, 11)]),
}
"""uv's name of a system, and pip's tags of the wheels that run there, by the name of docs/install.md."""
MACOS = "14.0"
"""The oldest macOS that wheels have to run on, as in docs/install.md."""


def pythons() -> list[str]:
    """The versions of Python that pyproject.toml names, such as 3.10."""
    rows = project(ROOT)["classifiers"]
    return [row.rpartition(" ")[2] for row in rows if row.startswith("Programming Language :: Python :: 3.")]


def resolved(system: str, python: str, extras: list[str]) -> tuple[list[str], str]:
    """Pinned requirements, NAME==VERSION, that have wheels on a system; or none, and uv's reason."""
    command = [sys.executable, "-m", "uv", "pip", "compile", "--quiet", "--no-header", "--no-annotate", "--no-sources"]
    command += ["--only-binary", ":all:", "--python-version", python, "--python-platform", SYSTEM_TAGS[system][0]]
    command += [word for extra in extras for word in ("--extra", extra)]
    variables = {**_variables(), "MACOSX_DEPLOYMENT_TARGET": MACOS}
    result = subprocess.run(
        [*command, "pyproject.toml"], cwd=ROOT, env=variables, capture_output=True, text=True, check=False
    )
    if result.returncode != 0:
        return [], result.stderr.strip()
    return result.stdout.split(), ""


def pip_finds(system: str, python: str, pinned: list[str]) -> str:
    """Return "" if pip finds a wheel of each pinned requirement; otherwise pip's reason."""
    tags = [word for tag in SYSTEM_TAGS[system][1] for word in ("--platform", tag)]
    with tempfile.TemporaryDirectory() as folder:
        listed = Path(folder) / "pinned.txt"
        listed.write_text("\n".join(pinned) + "\n", "utf-8")
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--no-deps", "--ignore-installed"]
        command += ["--ignore-requires-python"]  # pip would check the running Python; uv checked `python`
        command += ["--target", folder, "--only-binary", ":all:", "--python-version", python, *tags, "-r", str(listed)]
        result = subprocess.run(command, env=_variables(), capture_output=True, text=True, check=False)
    errors = [line for line in result.stderr.splitlines() if line.startswith("ERROR: ")]
    return "" if result.returncode == 0 else "; ".join(errors) or f"pip ended with status {result.returncode}"


def main(arguments: list[str]) -> int:
    """Print a line for each system and Python. Returns 1 if a package has no wheel."""
    every = pythons()
    parser = argparse.ArgumentParser(description="Whether all packages have wheels.", allow_abbrev=False)
    parser.add_argument("--system", action="append", choices=list(SYSTEM_TAGS), help="default: all")
    parser.add_argument("--python", action="append", choices=every, help="default: all")
    parser.add_argument("--extra", action="append", default=[], metavar="EXTRA", help="an extra of pyproject.toml")
    asked = parser.parse_args(arguments)
    unknown = sorted(set(asked.extra) - set(project(ROOT)["optional-dependencies"]))
    if unknown:
        parser.error(f"--extra {unknown[0]}: not an extra of pyproject.toml")
    failed = False
    for system in asked.system or SYSTEM_TAGS:
        for python in asked.python or every:
            pinned, reason = resolved(system, python, asked.extra)
            reason = reason or pip_finds(system, python, pinned)
            failed = failed or bool(reason)
            print(f"{system}, Python {python}: {reason or f'{len(pinned)} packages, all as wheels'}", flush=True)
    return 1 if failed else 0


def _variables() -> dict[str, str]:
    """Return the environment variables, with pip's certificates and index also under uv's names."""
    variables = dict(os.environ)
    for pip, uv in (("PIP_CERT", "SSL_CERT_FILE"), ("PIP_INDEX_URL", "UV_DEFAULT_INDEX")):
        if pip in variables:
            variables.setdefault(uv, variables[pip])
    return variables


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        sys.exit(130)
