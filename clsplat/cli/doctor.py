# SPDX-License-Identifier: Apache-2.0
"""`clsplat doctor`: what is installed, what is missing, and what to do about it."""

from __future__ import annotations

import json
import os
import platform
import re
import sys
from dataclasses import asdict, dataclass
from importlib import metadata
from typing import TYPE_CHECKING

import clsplat
from clsplat.cli.options import Flag, Verb
from clsplat.cli.session import Services
from clsplat.progress import aligned

if TYPE_CHECKING:
    from clsplat.device.installation import Finding

_REQUIREMENT = re.compile(r"([A-Za-z0-9_.-]+).*?(?:extra == ['\"](\w+)['\"])?$")


@dataclass(frozen=True)
class Doctor(Verb):
    """Say what is installed and what is missing: packages, OpenCL drivers, devices, GPUs without a driver; and what to
    install for them on this system.

    Exit status 1 where something is missing without which nothing runs. Drivers are loaded in processes of their own,
    so that one which aborts is named. `clsplat selftest` then tests what a driver computes.
    """

    json: Flag = False
    """Print a JSON array instead of the lines."""


def run(verb: Doctor, _: Services) -> int:
    """Print the findings; 1 if something is missing without which nothing runs."""
    everything = lines()
    missing = [line for line in everything if line.state == "missing"]
    if verb.json:
        print(json.dumps([asdict(line) for line in everything], indent=2))
        return 1 if missing else 0
    rows: list[tuple[str, str, str]] = []
    for line in everything:
        rows.append((line.state, line.part, line.text))
        if line.advice:
            rows.append(("", "", f"-> {line.advice}"))
    print("\n".join(aligned(rows, left=range(3))))
    verdict = f"{len(missing)} missing" if missing else "Nothing is missing without which training does not run"
    print(
        f"{verdict}. What is advised is behind the arrows."
        if any(line.advice for line in everything)
        else f"{verdict}."
    )
    return 1 if missing else 0


def lines() -> list[Finding]:
    """Everything that is said of the installation."""
    from clsplat.device.installation import findings

    return [*_system(), *_packages(), *findings(), *_variables()]


def _system() -> list[Finding]:
    from clsplat.device.installation import Finding

    system = f"{platform.system()} {platform.release()}, {platform.machine()}"
    python = f"Python {platform.python_version()}, {sys.prefix}"
    return [
        Finding("clsplat", "ok", clsplat.__version__),
        Finding("system", "ok", system),
        Finding("python", "ok", python),
    ]


def _packages() -> list[Finding]:
    """A line for each package that clsplat needs, and for each extra whether its packages are there."""
    from clsplat.device.installation import Finding

    try:
        requirements = metadata.requires("clsplat") or []
    except metadata.PackageNotFoundError:
        return [Finding("package", "note", "clsplat runs from a folder and is not installed", "pip install .")]
    findings: list[Finding] = []
    extras: dict[str, list[tuple[str, str]]] = {}
    for text in requirements:
        match = _REQUIREMENT.match(text)
        assert match is not None, text
        name, extra = match[1], match[2]
        if name == "clsplat" or (";" in text and not extra):  # of some systems alone
            continue
        version = _version(name)
        if extra:
            extras.setdefault(extra, []).append((name, version))
        elif version:
            findings.append(Finding("package", "ok", f"{name} {version}"))
        else:
            findings.append(Finding("package", "missing", name, f"pip install '{text}'"))
    for extra, packages in extras.items():
        if extra in ("test", "dev"):
            continue
        lacking = [name for name, version in packages if not version]
        text = ", ".join(f"{name} {version or 'not installed'}" for name, version in packages)
        advice = f"if wanted: pip install 'clsplat[{extra}]'" if lacking else ""
        findings.append(Finding(f"[{extra}]", "note" if lacking else "ok", text, advice))
    return findings


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return ""


def _variables() -> list[Finding]:
    """Variables of the environment that change which driver is taken, or how."""
    from clsplat.device.installation import Finding
    from clsplat.device.quirks import VARIABLES

    names = sorted(name for name in os.environ if name.startswith("CLSPLAT_") or name in VARIABLES)
    return [Finding("variable", "note", f"{name}={os.environ[name]}") for name in names]
