# SPDX-License-Identifier: Apache-2.0
"""Makes and checks a release; `tools/release` runs it. CONTRIBUTING.md has the steps in order."""

from __future__ import annotations

import argparse
import datetime as dt
import sys
from pathlib import Path

from conda_recipe import write_recipe
from release_build import build, check_contents, interpreters, try_out
from release_checks import findings, prepare

ROOT = Path(__file__).resolve().parents[2]


def main(arguments: list[str]) -> int:
    """Do what the flags say. Returns 1 if a check failed."""
    parser = argparse.ArgumentParser(prog="tools/release", description=__doc__, allow_abbrev=False)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "--check", action="store_true", help="whether this commit can be released: version, changelog, licences, tag"
    )
    what.add_argument(
        "--prepare", action="store_true", help="date the changelog and CITATION.cff, let README install from the index"
    )
    what.add_argument(
        "--build", action="store_true", help="build sdist and wheel, check both, and run the demo from each"
    )
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "dist", help="folder of --build (default: dist)")
    parser.add_argument(
        "--python", action="append", default=[], metavar="PYTHON", help="interpreter to try with, may be repeated"
    )
    asked = parser.parse_args(arguments)
    if asked.prepare:
        today = dt.datetime.now(tz=dt.timezone.utc).date().isoformat()
        changed = prepare(ROOT, today)
        print(f"changed: {', '.join(changed)}; look at them and commit" if changed else "nothing to change")
        return 0
    if asked.check:
        return _check()
    try:
        pythons = interpreters(asked.python)
    except ValueError as error:
        parser.error(str(error))
    return _build(asked.output.resolve(), pythons)


def _check() -> int:
    """Print a line for each check. Returns 1 if one failed."""
    every = findings(ROOT)
    for each in every:
        print(f"{'FAILED' if each.problem else 'ok':8}{each.title}{': ' if each.problem else ''}{each.problem}")
    return 1 if any(each.problem for each in every) else 0


def _build(output: Path, pythons: list[str]) -> int:
    """Build the sdist and the wheel, check them, and run the demo from each.

    output: folder for these files and for the recipe of conda-forge. pythons: the interpreters that run the demo.
    """
    sdist, wheel = build(ROOT, output)
    check_contents(ROOT, sdist, wheel)
    write_recipe(sdist, output / "recipe.yaml")
    tried = [try_out(package, python) for python in pythons for package in (sdist, wheel)]
    print("\n".join(tried))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        sys.exit(130)
