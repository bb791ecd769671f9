# SPDX-License-Identifier: Apache-2.0
"""Names and sentences of the package, by rules: one word has one meaning, rooms stay small, docstrings are short."""

from __future__ import annotations

import ast
import functools
import re
from collections import Counter, defaultdict
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "clsplat"
MOST_MODULES = 13
"""Flat modules of a room or sub-room."""
A_FILE_A_THING = {"stages", "reference", "cli"}
"""Rooms with a module for each kernel file or verb."""
RIDDLES = frozenset(
    [
        *("answers", "beside", "doubts", "findings", "glance", "looked", "marked", "edges", "judging", "learnt"),
        *("neighbours", "pending", "refined", "watched", "account", "child", "known", "rehearsal", "tape", "traits"),
        *("trial", "exploring", "marking", "thinning", "verbs", "made_up", "trust", "cast", "existing", "sharing"),
        *("pairs", "objects", "times", "listed", "placed", "around", "records", "limit", "stand_in", "meta"),
        *("graphs", "subject", "labels", "gate", "stage", "utils", "helpers", "misc", "common", "stuff", "things"),
    ]
)
"""Module names that say nothing to a stranger."""
LONGEST_SENTENCE = 30
"""Words."""
ODD_RELATIVE = re.compile(
    r"\b(what|those (that|of|which)|that (by|of)|(that|which|what) (is|are) none|of which|is told|are told|beside)\b"
)
"""Relatives that make a reader go back: "what density control has of the view", "masks beside what is none"."""


@functools.cache
def trees() -> dict[Path, ast.Module]:
    return {path: ast.parse(path.read_text("utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}


def sentences() -> list[str]:
    """Sentences of all docstrings: of modules, classes, functions, fields and constants."""
    nodes = (node for tree in trees().values() for node in ast.walk(tree) if isinstance(node, ast.Expr))
    texts = (node.value.value for node in nodes if isinstance(node.value, ast.Constant))
    return [
        part for text in texts if isinstance(text, str) for part in re.split(r"(?<=[.!?])\s", " ".join(text.split()))
    ]


def test_a_class_name_is_that_of_one_class() -> None:
    names = Counter(node.name for tree in trees().values() for node in ast.walk(tree) if isinstance(node, ast.ClassDef))
    assert [name for name, count in names.items() if count > 1] == []


def test_a_public_constant_name_is_that_of_one_module() -> None:
    homes: dict[str, set[str]] = defaultdict(set)
    for path, tree in trees().items():
        for node in tree.body:
            for target in node.targets if isinstance(node, ast.Assign) else ():
                for each in target.elts if isinstance(target, ast.Tuple) else (target,):
                    if isinstance(each, ast.Name) and re.fullmatch(r"[A-Z][A-Z0-9_]+", each.id):
                        homes[each.id].add(str(path.relative_to(PACKAGE)))
    assert {name: places for name, places in homes.items() if len(places) > 1} == {}


def test_a_module_name_says_what_is_in_it() -> None:
    assert [str(path.relative_to(PACKAGE)) for path in trees() if path.stem in RIDDLES] == []


@pytest.mark.parametrize("room", sorted({path.parent for path in PACKAGE.rglob("__init__.py")} - {PACKAGE}), ids=str)
def test_a_room_is_small(room: Path) -> None:
    modules = [path.stem for path in room.glob("*.py") if path.stem != "__init__"]
    assert len(modules) <= MOST_MODULES or room.name in A_FILE_A_THING, modules


def test_sentences_are_short() -> None:
    """Equations and tables may be longer: one in two hundred."""
    every = sentences()
    long = [text[:100] for text in every if len(text.split()) > LONGEST_SENTENCE]
    assert len(long) <= len(every) / 200, "\n".join(long)


def test_sentences_have_a_noun_where_a_relative_would_do() -> None:
    """The pattern takes a good "what" for an odd one now and then: 3 in a hundred."""
    every = sentences()
    odd = [text[:100] for text in every if ODD_RELATIVE.search(text)]
    assert len(odd) <= 0.03 * len(every), "\n".join(odd)


def test_the_rule_finds_an_odd_relative() -> None:
    assert ODD_RELATIVE.search("Masks of some photographs, beside what is none.")
    assert not ODD_RELATIVE.search("A mask folder that also holds other images.")
