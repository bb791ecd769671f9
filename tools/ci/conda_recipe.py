#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""The recipe for conda-forge: read by conda's own reader, compared with the wheel's requirements, and its tests run.

    .venv/bin/python tools/ci/conda_recipe.py            # read it for each system, and compare
    .venv/bin/python tools/ci/conda_recipe.py --run      # and run its test commands in this environment

Needs the extra `release`.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from release_checks import project

ROOT = Path(__file__).resolve().parents[2]
RECIPE = ROOT / "packaging/conda/recipe.yaml"
SYSTEMS = {"linux-64": ("linux", "x86_64"), "osx-arm64": ("darwin", "arm64"), "win-64": ("win32", "AMD64")}
"""sys_platform and platform_machine of requirement markers, by conda's name of a system."""
CONDA_NAMES = {"openimageio": "py-openimageio"}
"""Names of packages at conda-forge where they differ from PyPI's."""
DRIVERS = {"linux-64": {"pocl": ""}, "osx-arm64": {"pocl": ""}, "win-64": {"intel-opencl-rt": ">=2024.2"}}
"""Requirements on CPU drivers, by system. On PyPI an extra of pyopencl has PoCL, and on macOS nothing has it."""
CHECKSUM = re.compile(r'^( *sha256: )"[0-9a-f]{64}"', re.MULTILINE)


def rendered(path: Path, system: str) -> dict[str, Any]:
    """The recipe as conda's reader understands it for a system. The reader raises an error if the file is not valid."""
    from rattler_build import PlatformConfig, RenderConfig, Stage0Recipe

    platform = PlatformConfig(target_platform=system, build_platform=system, host_platform=system)
    (variant,) = Stage0Recipe.from_file(path).render(render_config=RenderConfig(platform=platform))
    document: dict[str, Any] = variant.recipe.to_dict()
    return document


def run_requirements(document: dict[str, Any]) -> dict[str, str]:
    """Version ranges that a rendered recipe requires, by package, without Python and conda's virtual packages."""
    pairs = [str(entry).partition(" ")[::2] for entry in document["requirements"]["run"]]
    return {name: versions for name, versions in pairs if name != "python" and not name.startswith("__")}


def wheel_requirements(root: Path, system: str) -> dict[str, str]:
    """Version ranges that the wheel requires on a system, by package under conda-forge's name.

    tomli is among them for every Python, because a noarch package cannot depend on Python's version.
    """
    from packaging.requirements import Requirement

    platform, machine = SYSTEMS[system]
    values = {"sys_platform": platform, "platform_machine": machine, "python_version": "3.10"}
    needed = dict(DRIVERS[system])
    for text in project(root)["dependencies"]:
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate(values):
            name = requirement.name.lower().replace("_", "-")
            needed[CONDA_NAMES.get(name, name)] = str(requirement.specifier)
    return needed


def problems(path: Path, root: Path) -> list[str]:
    """Differences of the recipe's requirements from the wheel's, for each system."""
    found = []
    for system in SYSTEMS:
        stated, needed = run_requirements(rendered(path, system)), wheel_requirements(root, system)
        for name in sorted({*stated, *needed}):
            if stated.get(name) != needed.get(name):
                has, wants = (repr(each[name]) if name in each else "nothing" for each in (stated, needed))
                found.append(f"{path.name}, {system}: {name} has {has}, expected {wants} as in pyproject.toml")
    return found


def commands(document: dict[str, Any]) -> list[str]:
    """The test commands of a rendered recipe, imports first."""
    listed = []
    for test in document["tests"]:
        if "python" in test:
            modules = test["python"]["imports"]
            listed.append(f"python -c 'import {', '.join(modules)}'")
        else:
            script = test["script"]
            listed += script if isinstance(script, list) else str(script["content"]).splitlines()
    return [line for line in listed if line.strip()]


def write_recipe(sdist: Path, output: Path) -> None:
    """Write the recipe with the checksum of an sdist, as conda-forge needs it."""
    digest = hashlib.sha256(sdist.read_bytes()).hexdigest()
    text, count = CHECKSUM.subn(rf'\g<1>"{digest}"', RECIPE.read_text("utf-8"))
    if count != 1:
        sys.exit(f"{RECIPE}: {count} lines of sha256, expected one with 64 digits")
    output.write_text(text, "utf-8")


def main(arguments: list[str]) -> int:
    """Read and compare; with --run also run the tests. Returns 1 if anything failed."""
    parser = argparse.ArgumentParser(description="Check the recipe for conda-forge.", allow_abbrev=False)
    parser.add_argument("--run", action="store_true", help="run the test commands in this environment")
    asked = parser.parse_args(arguments)
    found = problems(RECIPE, ROOT)
    print(
        "\n".join(found) or f"{RECIPE.relative_to(ROOT)}: valid for {', '.join(SYSTEMS)}, with the wheel's requirements"
    )
    if found or not asked.run:
        return 1 if found else 0
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    with tempfile.TemporaryDirectory() as folder:
        for command in commands(rendered(RECIPE, "linux-64")):
            print(f"$ {command}", flush=True)
            environment = {**os.environ, "PATH": path}
            if subprocess.run(command, shell=True, cwd=folder, env=environment, check=False).returncode != 0:  # noqa: S602
                return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
