# SPDX-License-Identifier: Apache-2.0
"""Write the table of docs/other-programs.md from the tests' marks `brings`: what other programs write, what
clsplat reads of it, and the test of it.

    python3 tools/ci/other_programs.py

`tests/tools/test_other_programs.py` fails if the page has another table.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "other-programs.md"
BEGIN, END = "<!-- made by tools/ci/other_programs.py -->\n", "<!-- end -->\n"
MARK = "pytest.mark.brings"


def rows() -> list[tuple[str, str, str, str]]:
    """Rows of the table: program, what it writes, what clsplat reads, and the test."""
    return sorted(row for path in sorted((ROOT / "tests").rglob("test_*.py")) for row in _marked(path))


def _marked(path: Path) -> Iterator[tuple[str, str, str, str]]:
    text = path.read_text("utf-8")
    if MARK not in text:
        return
    for function in ast.walk(ast.parse(text)):
        if isinstance(function, ast.FunctionDef):
            for mark in function.decorator_list:
                if isinstance(mark, ast.Call) and ast.unparse(mark.func) == MARK:
                    program, writes, read = (str(ast.literal_eval(argument)) for argument in mark.args)
                    yield program, writes, read, f"`{path.relative_to(ROOT / 'tests').as_posix()}`: `{function.name}`"


def table() -> str:
    """The table as Markdown."""
    lines = ["| program | writes | read | tested by, in `tests/` |", "|---|---|---|---|"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows())]) + "\n"


def page(text: str) -> str:
    """The page's text with the current table. text: the page's text so far."""
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    return before + BEGIN + table() + END + after


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text("utf-8")), "utf-8")
