# SPDX-License-Identifier: Apache-2.0
"""Write the table of docs/other-programs.md from the tests' marks `brings`: what other programs write, what
clsplat reads of it, and the test of it.

python3 tools/ci/other_programs.py            # write the table
python3 tools/ci/other_programs.py --check    # exit status 1 if the page has another table
"""

from __future__ import annotations

import argparse
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
    """The text of the page with the current table."""
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    return before + BEGIN + table() + END + after


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing")
    asked = parser.parse_args()
    now = PAGE.read_text("utf-8")
    wanted = page(now)
    if not asked.check:
        PAGE.write_text(wanted, "utf-8")
    elif now != wanted:
        print(f"{PAGE}: has another table than the tests' marks, expected what tools/ci/other_programs.py writes")
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
