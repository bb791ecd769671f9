# SPDX-License-Identifier: Apache-2.0
"""Checks of a commit that is to be released: version, tag, changelog, clean tree, and a licence for each file of the
wheel and of the sdist. `tools/release --check` prints the findings."""

from __future__ import annotations

import functools
import re
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

VERSION = re.compile(r"\d+\.\d+\.\d+(rc\d+)?")
"""Versions that are released: three numbers, and rcN of a candidate."""
FREE = {"Apache-2.0", "BSD-2-Clause", "BSD-3-Clause", "CC-BY-4.0", "CC0-1.0", "ISC", "MIT"}
"""SPDX identifiers of licences under which files of others may be bundled with code under Apache-2.0."""
HEADER = re.compile(r"SPDX-License-Identifier: *([\w.+-]+)")
HEADER_LINES = 5
"""Number of lines at the top of a file in which its licence is looked for."""
VERSIONED = {
    "CITATION.cff": r"^version: *([^\s]+)$",
    "packaging/conda/recipe.yaml": r"^ *version: *\"([^\"\s]+)\"$",
}
"""Patterns of the version in the files beside pyproject.toml that state it, by file."""
INSTALLS = {
    "README.md": {"      # from a checkout; Windows: .venv\\Scripts": "      # Windows: .venv\\Scripts"},
    "docs/install.md": {"From a checkout:": "With Python's own tools:"},
}
"""Lines that speak of a checkout, by file: before the first upload to the package index, and what replaces them."""
CHECKOUT_FOLDER = re.compile(r"(?<=pip install )\.(?=[\s`])|(?<!-e ')(?<=')\.(?=\[)")
"""The folder of the checkout in what pip installs, such as the dot in '.[view]', which becomes the package's name. An
editable install (-e) stays one of a checkout, as do all in CONTRIBUTING.md, which is for developers."""
MOST_NAMED = 5
"""Number of files that a message names before it counts the others."""


@dataclass(frozen=True)
class Finding:
    """A check of a release. problem: what is wrong and what to do; empty if the check passed."""

    title: str
    problem: str


def project(root: Path) -> dict[str, Any]:
    """The table `project` of pyproject.toml."""
    table: dict[str, Any] = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]
    return table


def findings(root: Path) -> list[Finding]:
    """Check the checkout's commit, in the order of a release. Returns a finding for each check."""
    version = project(root)["version"]
    checks: list[tuple[str, Callable[[], str]]] = [
        (f"version {version}", lambda: version_problem(root)),
        ("changelog", lambda: changelog_problem(root, version)),
        ("install lines", lambda: install_problem(root)),
        ("licences", lambda: licence_problem(root)),
        ("clean tree", lambda: tree_problem(root)),
        (f"tag v{version}", lambda: tag_problem(root, version)),
    ]
    return [Finding(title, check()) for title, check in checks]


def version_problem(root: Path) -> str:
    """Check that the version matches VERSION, and is the same in every file. Returns the problem or ""."""
    version = project(root)["version"]
    if not VERSION.fullmatch(version):
        return f"pyproject.toml: version {version!r}, expected three numbers such as 0.1.0, or 0.1.0rc1"
    for name, pattern in VERSIONED.items():
        stated = re.findall(pattern, (root / name).read_text("utf-8"), re.MULTILINE)
        if stated != [version]:
            found = ", ".join(stated) or "none"
            return f"{name}: version {found}, expected {version} as in pyproject.toml"
    return ""


def changelog_problem(root: Path, version: str) -> str:
    """Check that an empty section [Unreleased] and a dated section of the version open the changelog.

    Returns the problem or "".
    """
    text = (root / "CHANGELOG.md").read_text("utf-8")
    sections = re.split(r"^## \[(.+?)\](.*)$", text, flags=re.MULTILINE)[1:]
    names = sections[::3]
    advice = "tools/release --prepare makes it"
    if names[:1] != ["Unreleased"] or version not in names:
        return f"CHANGELOG.md: no section [{version}] below [Unreleased]; {advice}"
    if names[1] != version:
        return f"CHANGELOG.md: the newest section is [{names[1]}], expected [{version}]; {advice}"
    if not re.fullmatch(r" - \d{4}-\d\d-\d\d", sections[4]):
        return f"CHANGELOG.md: the line of [{version}] ends in {sections[4]!r}, expected a date such as ' - 2026-11-30'"
    if not sections[5].strip():
        return f"CHANGELOG.md: the section [{version}] is empty, expected what changed"
    if sections[2].strip():
        return f"CHANGELOG.md: [Unreleased] has lines, which [{version}] would not list; {advice}"
    return ""


def install_problem(root: Path) -> str:
    """Check that README and all pages install from the package index. Returns the problem or ""."""
    advice = "tools/release --prepare changes the lines about installing"
    for name in pages(root):
        text = (root / name).read_text("utf-8")
        changed = [line for line in text.splitlines() if from_index(name, line) != line]
        if changed:
            return f"{name}: the line {changed[0].strip()[:80]!r} installs from a checkout; {advice}"
        if missing := [after for after in INSTALLS.get(name, {}).values() if after not in text]:
            return f"{name}: no line {missing[0].strip()}; {advice}"
    return ""


def pages(root: Path) -> list[str]:
    """Names of the files that tell users how to install: README and the pages of the docs."""
    return ["README.md", *sorted(path.relative_to(root).as_posix() for path in (root / "docs").rglob("*.md"))]


def from_index(name: str, text: str) -> str:
    """Return lines of a file with packages from the package index in place of a checkout. name: the file's."""
    for before, after in INSTALLS.get(name, {}).items():
        text = text.replace(before, after)
    return CHECKOUT_FOLDER.sub("clsplat", text)


def tree_problem(root: Path) -> str:
    """Check that no file is changed, and that git knows or ignores every file. Returns the problem or ""."""
    changed = _git(root, "status", "--porcelain").splitlines()
    return f"{named(line[3:] for line in changed)}: not committed; commit or remove what differs" if changed else ""


def tag_problem(root: Path, version: str) -> str:
    """Check that the commit has the tag of the version, and of no other version. Returns the problem or ""."""
    tags = _git(root, "tag", "--points-at", "HEAD", "--list", "v*").split()
    if not tags:
        return (
            f"no tag at this commit, expected v{version}: git tag --annotate v{version} --message 'clsplat {version}'"
        )
    wrong = [tag for tag in tags if tag != f"v{version}"]
    return f"tag {named(wrong)} at this commit, but pyproject.toml has version {version}" if wrong else ""


def licence_problem(root: Path) -> str:
    """Check that every bundled file has a licence in FREE, stated in the file or in REUSE.toml.

    The text of the licence has to be in the checkout. Returns the problem or "".
    """
    stated = {name: licence_of(root, name) for name in bundled(root)}
    without = [name for name, licence in stated.items() if licence is None]
    if without:
        return f"{named(without)}: no licence; add a line SPDX-License-Identifier, or a row of REUSE.toml"
    for name, licence in stated.items():
        if licence not in FREE:
            return f"{name}: licence {licence}, expected one of {', '.join(sorted(FREE))}; it cannot be bundled"
        if licence != "Apache-2.0" and not (root / f"LICENSES/{licence}.txt").is_file():
            return f"{name}: licence {licence}, whose text is missing; write it to LICENSES/{licence}.txt"
    return ""


def licence_of(root: Path, name: str) -> str | None:
    """The SPDX identifier of a file's licence; None if neither the file nor REUSE.toml states it."""
    with open(root / name, "rb") as file:
        top = b"".join(file.readline() for _ in range(HEADER_LINES)).decode("utf-8", "replace")
    found = HEADER.search(top)
    if found:
        return found[1]
    rows = _annotations(root / "REUSE.toml")
    return next((licence for pattern, licence in reversed(rows) if pattern.fullmatch(name)), None)


def bundled(root: Path) -> list[str]:
    """Return the files in git that the sdist has to contain, sorted. They include all files of the wheel."""
    document = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))
    only = document["tool"]["hatch"]["build"]["targets"]["sdist"]["only-include"]
    listed = _git(root, "ls-files", "-z", "--", *only, "pyproject.toml", ".gitignore")  # hatchling adds these two
    return sorted({name for name in listed.split("\0") if name and (root / name).is_file()})


def named(names: Iterable[str]) -> str:
    """The first names of a list, and the number of the others."""
    every = list(names)
    more = len(every) - MOST_NAMED
    return ", ".join(every[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def prepare(root: Path, date: str) -> list[str]:
    """Write what the tagged commit needs. Returns the names of the changed files.

    This is the changelog's section of the version, the date in CITATION.cff, and the lines about installing.

    date: date of the release, such as 2026-11-30.
    """
    version = project(root)["version"]
    texts = {name: (root / name).read_text("utf-8") for name in ("CHANGELOG.md", "CITATION.cff", *pages(root))}
    new = dict(texts)
    if f"\n## [{version}]" not in texts["CHANGELOG.md"]:
        top = "## [Unreleased]\n"
        new["CHANGELOG.md"] = texts["CHANGELOG.md"].replace(top, f"{top}\n## [{version}] - {date}\n", 1)
    dated = re.sub(r"^date-released:.*\n", "", texts["CITATION.cff"], flags=re.MULTILINE)
    new["CITATION.cff"] = re.sub(r"^(version: .*\n)", rf"\1date-released: {date}\n", dated, count=1, flags=re.MULTILINE)
    for name in pages(root):
        new[name] = from_index(name, new[name])
    changed = [name for name, text in texts.items() if new[name] != text]
    for name in changed:
        (root / name).write_text(new[name], "utf-8")
    return changed


@functools.cache
def _annotations(path: Path) -> list[tuple[re.Pattern[str], str]]:
    """Return the rows of REUSE.toml: a pattern of file names, and a licence. Of matching rows, the last applies.

    In a glob `*` matches names in one folder, and `**` also names in sub-folders.
    """
    wild = {"**": ".*", "*": "[^/]*"}
    return [
        (re.compile("".join(wild.get(part, re.escape(part)) for part in re.split(r"(\*\*|\*)", glob))), licence)
        for row in tomllib.loads(path.read_text("utf-8"))["annotations"]
        for licence in [row["SPDX-License-Identifier"]]
        for glob in row["path"]
    ]


def _git(root: Path, *arguments: str) -> str:
    command = ["git", "-C", str(root), *arguments]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode != 0:
        sys.exit(
            f"tools/release: git {arguments[0]} failed in {root}: {result.stderr.strip()}; expected a git checkout"
        )
    return result.stdout
