# SPDX-License-Identifier: Apache-2.0
"""Docstrings, comments and messages are plain English: the habits that can be told by a pattern."""

from __future__ import annotations

import ast
import functools
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
OPENINGS = re.compile(r"\s*(What|Whether|Who|Whom|If|As)\b")
"""A docstring opens with a noun phrase or a verb; a predicate reads "True if ..."."""
BANNED = (
    r"\bfor whom?\b",
    r"(?<!near )(?<!far )\bas (?!near|far)[^.;:,]{1,28} (has|have) (it|them)\b",
    r"\b(is|are) to be had\b",
    r"\bwhat there is\b",
    r"\ball of them in\b",
    r"\bsomebody\b",
)
"""Phrases that have a plainer form: "for the thread that ...", "like the library's", "the rest", "another program"."""


def sources(*folders: str) -> list[Path]:
    """Python files of the folders, and their scripts without an ending."""
    paths = (path for folder in folders for path in sorted((ROOT / folder).rglob("*")) if path.is_file())
    return [path for path in paths if path.suffix == ".py" or (not path.suffix and _is_script(path))]


def _is_script(path: Path) -> bool:
    with path.open("rb") as file:
        return b"python" in file.readline() if file.read(2) == b"#!" else False


def docstrings(text: str) -> Iterator[tuple[int, str]]:
    """Line and text of each string that stands alone: of modules, classes, functions, fields and constants."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.lineno, node.value.value


@functools.cache
def package() -> tuple[tuple[str, str], ...]:
    """Place and text of each comment and string of clsplat/."""
    paths = [(path.relative_to(ROOT), path) for path in sources("clsplat")]
    return tuple((f"{name}:{line}", text) for name, path in paths for line, text in words(path.read_text("utf-8")))


def words(text: str) -> Iterator[tuple[int, str]]:
    """Line and text of each comment and string; comments on lines one below the other as one, in one line."""
    block, last = "", -1
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            joined = f"{block} {token.string.lstrip('# ')}" if token.start[0] == last + 1 else token.string
            block, last = joined, token.start[0]
            yield token.start[0], block
        elif token.type == tokenize.STRING or tokenize.tok_name[token.type].startswith("FSTRING"):
            yield token.start[0], " ".join(token.string.split())


def test_a_docstring_opens_with_a_noun_or_a_verb() -> None:
    paths = sources("clsplat", "tools")
    assert len(paths) > 150
    found = [
        f"{path.relative_to(ROOT)}:{line}: {text.strip()[:60]}"
        for path in paths
        for line, text in docstrings(path.read_text("utf-8"))
        if OPENINGS.match(text)
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("phrase", BANNED)
def test_a_phrase_is_in_no_comment_and_no_string(phrase: str) -> None:
    found = [f"{place}: {text[:120]}" for place, text in package() if re.search(phrase, text, re.IGNORECASE)]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("text", ['"""What it is."""', 'X = 1\n"""Whether it is."""', 'def f():\n    """As `g`."""'])
def test_the_rule_finds_what_breaks_it(text: str) -> None:
    assert [line for line, found in docstrings(text) if OPENINGS.match(found)]


def test_a_phrase_is_found_across_lines() -> None:
    text = "# this is for\n# who encodes it\nX = '''as the file\n    has it'''\n"
    for phrase in BANNED[:2]:
        assert any(re.search(phrase, found, re.IGNORECASE) for _, found in words(text)), phrase
