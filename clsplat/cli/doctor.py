# SPDX-License-Identifier: Apache-2.0
"""`clsplat doctor`: list of installed and missing packages and OpenCL drivers, with advice on installing them."""

from __future__ import annotations

import json
import os
import platform
import re
import sys
from dataclasses import asdict, dataclass
from importlib import metadata
from typing import TYPE_CHECKING

from clsplat.cli.options import Flag, Verb
from clsplat.cli.session import Services
from clsplat.progress import aligned
from clsplat.version import package_version

if TYPE_CHECKING:
    from clsplat.device.drivers.diagnostics import Diagnostic

_REQUIREMENT = re.compile(r"([A-Za-z0-9_.-]+).*?(?:extra == ['\"](\w+)['\"])?$")
"""Pattern of a requirement in the metadata of the installed package. Group 1 is the required package, group 2 the extra
of clsplat that requires it, if any."""


@dataclass(frozen=True)
class DoctorVerb(Verb):
    """List installed and missing packages, OpenCL drivers, devices and GPUs without a driver, with installation advice
    for this system.

    The exit status is 1 if anything essential is missing. Each driver is loaded in a separate process, so that a
    driver that aborts can be named. `clsplat selftest` tests the results of a driver.
    """

    json: Flag = False
    """Print a JSON array instead of the lines."""


def run(verb: DoctorVerb, _: Services) -> int:
    """Print the findings about the installation. Returns 1 if anything essential is missing."""
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
    verdict = f"{len(missing)} missing" if missing else "Everything that training needs is present"
    print(f"{verdict}. Advice is behind the arrows." if any(line.advice for line in everything) else f"{verdict}.")
    return 1 if missing else 0


def lines() -> list[Diagnostic]:
    """Return all findings about the installation: system, packages, drivers and environment variables."""
    from clsplat.device.drivers.diagnostics import findings

    return [*_system(), *_packages(), *findings(), *_variables()]


def _system() -> list[Diagnostic]:
    from clsplat.device.drivers.diagnostics import Diagnostic

    system = f"{platform.system()} {platform.release()}, {platform.machine()}"
    python = f"Python {platform.python_version()}, {sys.prefix}"
    return [
        Diagnostic("clsplat", "ok", package_version()),
        Diagnostic("system", "ok", system),
        Diagnostic("python", "ok", python),
    ]


def _packages() -> list[Diagnostic]:
    """Findings about the packages that clsplat requires, and about the packages of each extra."""
    from clsplat.device.drivers.diagnostics import Diagnostic

    try:
        requirements = metadata.requires("clsplat") or []
    except metadata.PackageNotFoundError:
        return [Diagnostic("package", "note", "clsplat runs from a folder and is not installed", "pip install .")]
    findings: list[Diagnostic] = []
    extras: dict[str, list[tuple[str, str]]] = {}
    for text in requirements:
        match = _REQUIREMENT.match(text)
        assert match is not None, text
        name, extra = match[1], match[2]
        # skip clsplat itself, and packages that only some systems or versions of Python need
        if name == "clsplat" or (";" in text and not extra):
            continue
        version = _version(name)
        if extra:
            extras.setdefault(extra, []).append((name, version))
        elif version:
            findings.append(Diagnostic("package", "ok", f"{name} {version}"))
        else:
            findings.append(Diagnostic("package", "missing", name, f"pip install '{text}'"))
    for extra, packages in extras.items():
        if extra in ("test", "dev"):
            continue
        lacking = [name for name, version in packages if not version]
        text = ", ".join(f"{name} {version or 'not installed'}" for name, version in packages)
        advice = f"if wanted: pip install 'clsplat[{extra}]'" if lacking else ""
        findings.append(Diagnostic(f"[{extra}]", "note" if lacking else "ok", text, advice))
    return findings


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return ""


def _variables() -> list[Diagnostic]:
    """Findings about environment variables that choose a driver or change its behaviour."""
    from clsplat.device.drivers.diagnostics import Diagnostic
    from clsplat.device.drivers.quirks import DRIVER_VARIABLES

    names = sorted(name for name in os.environ if name.startswith("CLSPLAT_") or name in DRIVER_VARIABLES)
    return [Diagnostic("variable", "note", f"{name}={os.environ[name]}") for name in names]
