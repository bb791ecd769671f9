# SPDX-License-Identifier: Apache-2.0
"""Projections are one table, and what a splat and a ray share is one layout."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import get_args

import clsplat
from clsplat.camera import BENT_FISHEYE, PROJECTIONS, Projection
from clsplat.device.layout import COUNTED, RAY, READBACK, REFUSED, SPLAT, header
from clsplat.device.source import kernel_root

PACKAGE = Path(clsplat.__file__).parent
KERNELS = "".join(path.read_text("utf-8") for path in kernel_root().rglob("*.[ch]*"))
OF_FILES = {"shots/nerfstudio.py", "shots/usd.py"}
"""Modules with lists of what a file format can have."""


def test_every_projection_has_a_row() -> None:
    assert tuple(PROJECTIONS) == get_args(Projection)
    defines = [tuple(kind.defines.items()) for kind in (*PROJECTIONS.values(), BENT_FISHEYE)]
    assert len(set(defines)) == len(defines), "each is a build of its own"


def test_the_kernels_look_at_every_define() -> None:
    for kind in (*PROJECTIONS.values(), BENT_FISHEYE):
        assert ("RAYS" in kind.defines) == (not kind.flat)
        for name in kind.defines:
            assert re.search(rf"#\s*(if|ifdef|ifndef|elif)\b.*\b{name}\b", KERNELS), name


def test_no_module_has_a_list_of_projections_of_its_own() -> None:
    own = {}
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            items = node.keys if isinstance(node, ast.Dict) else getattr(node, "elts", [])
            names = {item.value for item in items if isinstance(item, ast.Constant)} & set(PROJECTIONS)
            if len(names) > 1:
                own[str(path.relative_to(PACKAGE))] = names
    assert set(own) - OF_FILES == {"camera.py"}, own


def test_blending_reads_splats_and_rays_alike() -> None:
    """kernels/shared/alpha.h has one name for each, whichever it is."""
    assert len(SPLAT) == len(RAY)
    shared = set(SPLAT) & set(RAY)
    assert shared == {"LOG2O", "RED", "GREEN", "BLUE", "DEPTH"}
    assert {name: SPLAT.index(name) for name in shared} == {name: RAY.index(name) for name in shared}


def test_what_is_read_back_has_names_in_the_kernels() -> None:
    assert (*COUNTED, "STOPPED", *(f"REFUSED_{reason.upper()}" for reason in REFUSED)) == READBACK
    for place, name in enumerate(READBACK):
        assert f"#define READBACK_{name} {place}\n" in header()
        assert re.search(rf"\bREADBACK_{name}\b", KERNELS), name
