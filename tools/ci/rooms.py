#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Make the table of packages in docs/architecture.md, from the import contracts and the packages' docstrings.

    python3 tools/ci/rooms.py [--write]

Prints the table; --write puts it into the page. The order of packages is that of `[tool.importlinter]` in
pyproject.toml, from the top. Inside a package with a contract of its own, a module imports only modules listed behind
it.
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs/architecture.md"
HEAD = "| room | what is in it | modules, from the top where a contract orders them |"
UNLISTED = {"stages", "reference", "cli"}
"""Packages with a module for each kernel file or verb, which are too many to list."""


def what(folder: Path) -> str:
    """The first paragraph of a package's docstring."""
    text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text("utf-8"))) or ""
    return " ".join(text.partition("\n\n")[0].split())


def orders() -> dict[str, list[str]]:
    """The layers of each contract, from the top, keyed by the contract's package; "" is clsplat itself."""
    document = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    contracts = document["tool"]["importlinter"]["contracts"]
    return {
        contract["containers"][0].removeprefix("clsplat").removeprefix("."): [
            name for layer in contract["layers"] for name in layer.replace(":", "|").replace(" ", "").split("|")
        ]
        for contract in contracts
        if contract["type"] == "layers"
    }


def table() -> str:
    """The table as Markdown, with a row for each package and subpackage."""
    order = orders()
    rows = [HEAD, "|---|---|---|"]

    def add(room: str) -> None:
        folder = ROOT / "clsplat" / room.replace(".", "/")
        if not (folder / "__init__.py").is_file():
            return
        names = order.get(room) or sorted(path.stem for path in folder.glob("[!_]*") if path.suffix in {"", ".py"})
        inside = "" if room in UNLISTED else ", ".join(f"`{name}`" for name in names)
        rows.append(f"| `{room.replace('.', '/')}` | {what(folder)} | {inside} |")
        for name in sorted((path.parent.name for path in folder.glob("*/__init__.py")), key=names.index):
            add(f"{room}.{name}")

    for room in order[""]:
        add(room)
    return "\n".join(rows) + "\n"


def page() -> str:
    """The text of the page with the current table."""
    before, head, rest = PAGE.read_text("utf-8").partition(HEAD)
    return f"{before}{table()}\n{rest.partition(chr(10) * 2)[2]}" if head else before


if __name__ == "__main__":
    if "--write" in sys.argv[1:]:
        PAGE.write_text(page(), "utf-8")
    else:
        print(table(), end="")
