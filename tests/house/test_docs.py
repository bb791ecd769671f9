# SPDX-License-Identifier: Apache-2.0
"""README.md and its like, and docs/, against the code: the commands that they give, and the flags, files, tests and
places they name."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
from calls import Capture, printed

from clsplat.cli.main import parse
from clsplat.cli.parsing import VERBS

ROOT = Path(__file__).resolve().parents[2]
DOORS = ("README.md", "CONTRIBUTING.md", "SECURITY.md")
PAGES = [*(ROOT / name for name in DOORS), *sorted((ROOT / "docs").rglob("*.md"))]
FENCED = re.compile(r"^( *)```.*?\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"(?<=\n\n)(?: {4}\S.*\n)+")
NOT_HERE = {"clsplat/drivers.json", "clsplat/binaries", "clsplat/kernels", "clsplat/render.py"}
"""In the user's cache folder, in the wheel, and a name that decision 0009 rejects."""
NO_TESTS = {"test_every", "test_filenames"}


def code_of(page: Path) -> Iterator[str]:
    """The lines of blocks of code: continued ones joined, comments and redirections taken off."""
    text = page.read_text("utf-8")
    blocks = [block for _, block in FENCED.findall(text)] + INDENTED.findall(FENCED.sub("", text))
    for line in "".join(blocks).replace("\\\n", " ").splitlines():
        yield re.sub(r"\s+(#|>) .*", "", line.strip())


def spans_of(page: Path) -> Iterator[str]:
    """Words between backticks in the text."""
    for span in re.findall(r"`([^`]+)`", FENCED.sub("", page.read_text("utf-8"))):
        yield " ".join(span.split())


LINES = [line for page in PAGES for line in code_of(page)]
SPANS = [(page.relative_to(ROOT).as_posix(), span) for page in PAGES for span in spans_of(page)]
VALUES = dict(pair for line in LINES for pair in re.findall(r'^([A-Z]+)="(.*)"$', line))
COMMANDS = sorted({line for line in LINES if line.startswith("clsplat ")})


def flags_in(text: str) -> set[str]:
    return set(re.findall(r"(?<![\w-])(--[a-z][\w.-]*\w|-[a-z]\b)", text))


def test_the_blocks_are_found() -> None:
    assert len(COMMANDS) > 40
    assert any("$S" in command for command in COMMANDS) and "S" in VALUES


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_in_a_block_parses(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, value in VALUES.items():
        command = re.sub(rf"\${name}\b", value, command)
    parse(shlex.split(command)[1:])


TWO_WORDS = "|".join(name for name in VERBS if " " in name)
"""Verbs of two words, as alternatives of a pattern."""


def test_flags_are_those_of_their_verb(capsys: Capture) -> None:
    flags = {}
    for name in VERBS:
        flags[name] = flags_in(printed(capsys, [name, "--help"]).out)
    every = set.union(*flags.values()) | flags_in("".join(path.read_text("utf-8") for path in tools()))
    wrong = []
    for page, span in SPANS:
        verb = re.match(rf"clsplat ({TWO_WORDS}|[a-z]+)\b", span)
        known = flags.get(verb[1], set()) if verb else every
        if verb and verb[1] not in flags:
            wrong.append((page, span))
        elif verb or span.startswith("--"):
            for flag in flags_in(span):
                named = flag.removesuffix(".NAME")
                if not any(each == named or (flag != named and each.startswith(f"{named}.")) for each in known):
                    wrong.append((page, span))
    assert wrong == []


def tools() -> list[Path]:
    return [path for path in (ROOT / "tools").rglob("*") if path.is_file() and path.suffix != ".pyc"]


def test_tools_take_their_flags() -> None:
    calls = [line for line in LINES + [span for _, span in SPANS] if re.match(r"(python )?tools/\w", line)]
    assert len(calls) > 20
    wrong = []
    for call in calls:
        path = ROOT / call.removeprefix("python ").split()[0]
        if not path.is_file():
            wrong.append(call)
        elif path.name != "test":  # which hands them on to pytest
            shared = [ROOT / "tools/bench/measuring.py", ROOT / f"tools/ci/{path.stem}_command.py"]
            parts = [path, *shared, *(path.parent.iterdir() if path.stem == "run" else ())]
            text = "".join(part.read_text("utf-8") for part in parts if part.is_file())
            wrong += [call for flag in flags_in(call) if f'"{flag}"' not in text]
    assert wrong == []


def test_files_and_tests_that_are_named_are_there() -> None:
    inside = re.compile(r"(clsplat|docs|kernels|tests|tools|\.ci|\.github)/[\w./-]*")
    names = {path.name for part in ("clsplat", "kernels", "tests", "tools") for path in (ROOT / part).rglob("*.*")}
    tests = [path.read_text("utf-8") for path in (ROOT / "tests").rglob("*.py")]
    defined = set(re.findall(r"def (test_\w+)", "".join(tests)))
    wrong = []
    for page, span in SPANS:
        if inside.fullmatch(span):
            there = (ROOT / span).exists() or span in NOT_HERE or "STEM" in span
        elif re.fullmatch(r"\w+\.(py|cl|h)", span):
            there = span in names
        else:
            there = not re.fullmatch(r"test_\w+", span) or span in defined | NO_TESTS
        if not there:
            wrong.append((page, span))
    assert wrong == []


def test_every_environment_variable_has_a_row() -> None:
    sources = "".join(path.read_text("utf-8") for path in (ROOT / "clsplat").rglob("*.py"))
    read = set(re.findall(r"CLSPLAT_[A-Z_]+[A-Z]", sources))
    table = (ROOT / "docs" / "commands.md").read_text("utf-8").split("## Environment variables")[1]
    assert len(read) > 10
    assert read - set(re.findall(r"CLSPLAT_[A-Z_]+", table)) == set()


def test_links_lead_somewhere() -> None:
    wrong = []
    for page in PAGES:
        for link in re.findall(r"\]\(([^)\s]+)\)", FENCED.sub("", page.read_text("utf-8"))):
            name, _, place = link.partition("#")
            target = page.parent / name if name else page
            if re.match(r"[a-z]+:", link):
                continue
            if not target.exists() or (place and place not in places(target)):
                wrong.append((page.name, link))
    assert wrong == []


def places(page: Path) -> set[str]:
    """Anchors that GitHub gives the headings."""
    headings = re.findall(r"^#+ (.*)$", page.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}
