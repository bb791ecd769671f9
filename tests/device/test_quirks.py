# SPDX-License-Identifier: Apache-2.0
"""Drivers' names stand in one module."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from types import SimpleNamespace

import clsplat
from clsplat.device.drivers.quirks import register_limit

PACKAGE = Path(clsplat.__file__).parent
DRIVERS = re.compile(r"pocl|intel|rusticl|llvmpipe|\bmesa\b|nvidia|amd\b|ocl_icd|cl_config", re.IGNORECASE)


def names(path: Path) -> list[str]:
    """Drivers' names in a file's code: its names and texts, not its comments and docstrings."""
    text = path.read_text("utf-8")
    if not DRIVERS.search(text):
        return []
    tree = ast.parse(text)
    documentation = {
        id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    words = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documentation:
            words.append(node.value)
        words += [value for key in ("id", "attr", "name", "arg") if isinstance(value := getattr(node, key, None), str)]
    return [word for word in words if DRIVERS.search(word)]


def test_drivers_are_named_in_one_module() -> None:
    named = {str(path.relative_to(PACKAGE)): found for path in PACKAGE.rglob("*.py") if (found := names(path))}
    assert set(named) == {"device/drivers/quirks.py"}, named


def test_a_limit_of_registers_by_extension() -> None:
    words = ("cl_khr_fp64", "cl_nv_compiler_options")
    given = [register_limit(SimpleNamespace(extensions=" ".join(words[:count])), 96) for count in (1, 2)]  # type: ignore[arg-type]
    assert given == ["", "-cl-nv-maxrregcount=96"]
