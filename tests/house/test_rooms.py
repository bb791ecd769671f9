# SPDX-License-Identifier: Apache-2.0
"""Which room may import from which: `[tool.importlinter]` in pyproject.toml."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from calls import python

ROOT = Path(__file__).resolve().parents[2]
PUBLIC = {"clsplat/__init__.py", "clsplat/__main__.py", "clsplat/gaussians.py"}
"""The names that are loaded when they are first used, and `Gaussians.load` and `save`."""


def lint(root: Path) -> subprocess.CompletedProcess[str]:
    """The contracts, held against the package in `root`."""
    code = "import sys; from importlinter.cli import lint_imports_command; sys.exit(lint_imports_command())"
    path = os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])
    words, environment = ("--config", root / "pyproject.toml", "--no-cache"), {**os.environ, "PYTHONPATH": path}
    return python("-c", code, *words, cwd=root, env=environment, encoding="utf-8", timeout=120)


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package that a test may change."""
    root = tmp_path_factory.mktemp("copy")
    shutil.copytree(ROOT / "clsplat", root / "clsplat", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", root)
    return root


@pytest.mark.needs("importlinter")
def test_every_contract_is_kept() -> None:
    done = lint(ROOT)
    assert done.returncode == 0, done.stdout


@pytest.mark.needs("importlinter")
@pytest.mark.parametrize(
    ("module", "line", "told"),
    [
        (
            "images/colour.py",
            "from clsplat.models import edit",
            "clsplat.images is not allowed to import clsplat.models",
        ),
        ("report/charts.py", "import clsplat.viewer.pose", "clsplat.report is not allowed to import clsplat.viewer"),
        (
            "stages/scan.py",
            "from clsplat.reference import sort",
            "the twins are for tests, the self-test and the bench BROKEN",
        ),
        ("training/density/adaptive.py", "from clsplat.device import context", "policy sees no device BROKEN"),
        ("frame/lens.py", "from clsplat.device import buffers", "policy sees no device BROKEN"),
        ("stages/sort.py", "import pyopencl", "pyopencl is imported in device alone BROKEN"),
        ("hall.py", "import os", "The following modules are not listed as layers"),
    ],
)
def test_a_planted_import_is_found(copy: Path, module: str, line: str, told: str) -> None:
    path = copy / "clsplat" / module
    before = path.read_bytes() if path.exists() else None
    path.write_text((before or b"").decode() + f"\n{line}\n", "utf-8")
    try:
        done = lint(copy)
    finally:
        if before is None:
            path.unlink()
        else:
            path.write_bytes(before)
    assert done.returncode == 1
    assert told in " ".join(done.stdout.split())


LATE = {
    "clsplat.gaussians": {"clsplat.models.formats"},  # Gaussians.load and save
    "clsplat.cli.train": {"clsplat.cli.blocks.whole"},  # train --blocks, whose plan trains a coarse model by train
}
"""Imports that a function makes on purpose, against the order of the modules."""


@pytest.mark.needs("importlinter")  # which brings grimp
def test_no_imports_go_in_a_circle() -> None:
    """Imports for types alone count: a circle cannot be read from its beginning."""
    import grimp

    graph = grimp.build_graph("clsplat", exclude_type_checking_imports=False, cache_dir=None)
    imports = {name: graph.find_modules_directly_imported_by(name) - LATE.get(name, set()) for name in graph.modules}
    imports["clsplat"] = set()  # types of the public names, which are loaded when they are first used
    while outside := {name for name in imports if not imports[name] or not any(name in of for of in imports.values())}:
        imports = {name: of - outside for name, of in imports.items() if name not in outside}
    assert imports == {}


NOT_AT_THE_TOP = re.compile(r"^(?!from |import |#).*\bimport\b", re.MULTILINE)
"""A line with an import that may be a function's. Modules without such a line are not parsed, which saves 2 s."""


def test_imports_are_at_the_top_of_their_modules() -> None:
    """But in `cli`, so that --help is quick."""
    found = []
    for path in sorted((ROOT / "clsplat").rglob("*.py")):
        name = path.relative_to(ROOT).as_posix()
        if name in PUBLIC or name.startswith("clsplat/cli/"):
            continue
        text = path.read_text("utf-8")
        if not NOT_AT_THE_TOP.search(text):
            continue
        for function in ast.walk(ast.parse(text)):
            if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
                found += [
                    f"{name}:{node.lineno}"
                    for node in ast.walk(function)
                    if (isinstance(node, ast.ImportFrom) and (node.module or "").startswith("clsplat"))
                    or (isinstance(node, ast.Import) and any(each.name.startswith("clsplat") for each in node.names))
                ]
    assert found == []


def test_the_hall_is_small() -> None:
    """Modules at the top of the package may be imported from every room."""
    assert len(list((ROOT / "clsplat").glob("*.py"))) <= 12
