#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Build the site of every release and of this checkout, for a web server. Requires the extra `docs`, and git.

    .venv/bin/python tools/ci/site_versions.py [FOLDER]

Writes FOLDER (build/versions), with a folder for each release, named after its version, and `dev` for this checkout. A
release is a tag such as v0.1.0, and its own tools/ci/site.py builds its site. `latest` leads to the newest release. The
first page leads to `latest`, or to `dev` if there is no release. Each page has a list of the versions. mike collects
the sites in a temporary repository; this one stays as it is. .github/workflows/site.yml runs this program.

The exit status is 1 if the checkout's site has warnings, and 2 for a wrong call. A release whose site cannot be built
is left out, with a warning, as its tag stays as it is.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from mike import commands

ROOT = Path(__file__).resolve().parents[2]
RELEASE = re.compile(r"v(\d+)\.(\d+)\.(\d+)")
BRANCH = "site"
"""Branch of the temporary repository."""
CHECKOUT = "dev"
"""Name of the checkout's version."""


def git(folder: Path, *words: str) -> str:
    """Output of git in a folder. Raises CalledProcessError if it fails; git's message is then printed."""
    return subprocess.run(["git", *words], cwd=folder, check=True, stdout=subprocess.PIPE, text=True).stdout


def releases() -> list[str]:
    """Tags of the releases of the repository, the oldest first."""
    found = [match for tag in git(ROOT, "tag").split() if (match := RELEASE.fullmatch(tag))]
    return [match[0] for match in sorted(found, key=lambda match: tuple(map(int, match.groups())))]


def built(sources: Path, target: Path) -> bool:
    """Build the site of a checkout into `target`, by its own program. Returns whether there are no warnings."""
    environment = {**os.environ, "PYTHONPATH": str(sources), "MIKE_DOCS_VERSION": target.name}
    words = [sys.executable, str(sources / "tools/ci/site.py"), str(target)]
    return subprocess.run(words, env=environment, check=False, stdout=subprocess.DEVNULL).returncode == 0


def add(site: Path, version: str, *aliases: str) -> None:
    """Add the site in a folder to the branch BRANCH of the repository in the working folder.

    version: name of its folder in the branch. aliases: further names that lead to it, such as latest.
    """
    settings = {"site_dir": str(site), "use_directory_urls": False}
    redirect = commands.AliasType.redirect  # a symbolic link would be lost in a workflow's artefact
    with commands.deploy(
        settings, version, None, list(aliases), alias_type=redirect, branch=BRANCH, message=version, allow_empty=True
    ):
        pass  # mike adds what is in the folder at the end of the block


def build_all(scratch: Path) -> bool:
    """Build every version into the branch of the repository in the working folder. Returns True when all is built.

    If the checkout's site has warnings, returns False before any release is built. scratch: folder for sources and
    sites.
    """
    if not built(ROOT, scratch / "site" / CHECKOUT):
        return False
    kept = []
    for tag in releases():
        sources = scratch / tag
        git(scratch, "-c", "advice.detachedHead=false", "clone", "-q", "--branch", tag, ROOT.as_uri(), tag)
        if built(sources, scratch / "site" / tag):
            kept.append(tag)
        else:
            print(f"tools/ci/site_versions.py: left out {tag}: its site cannot be built", file=sys.stderr)
    for tag in kept:
        add(scratch / "site" / tag, tag.removeprefix("v"), *(["latest"] if tag == kept[-1] else []))
    add(scratch / "site" / CHECKOUT, CHECKOUT)
    commands.set_default("latest" if kept else CHECKOUT, branch=BRANCH)
    return True


def main() -> int:
    """Build the versions. Returns the exit status."""
    if len(sys.argv) > 2 or sys.argv[1:2] in (["-h"], ["--help"]):
        print(__doc__)
        return 0 if len(sys.argv) == 2 else 2
    target = Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "build/versions").resolve()
    if target.is_dir() and any(target.iterdir()) and not (target / "versions.json").is_file():
        print(f"tools/ci/site_versions.py: {target} has files but no versions.json; give a new folder", file=sys.stderr)
        return 2
    os.environ.update(GIT_COMMITTER_NAME="clsplat", GIT_COMMITTER_EMAIL="clsplat@example.org")  # for mike's commits
    with tempfile.TemporaryDirectory() as folder:
        repository = Path(folder, "repository")
        git(Path(folder), "init", "-q", "--bare", repository.name)
        os.chdir(repository)
        complete = build_all(Path(folder))
        if complete:
            shutil.rmtree(target, ignore_errors=True)
            target.mkdir(parents=True)
            git(repository, f"--work-tree={target}", "checkout", "-q", BRANCH, "--", ".")
        os.chdir(ROOT)  # Windows cannot remove the working folder of a process
    if complete:
        print(target / "index.html")
    return 0 if complete else 1


if __name__ == "__main__":
    sys.exit(main())
