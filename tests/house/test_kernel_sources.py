# SPDX-License-Identifier: Apache-2.0
"""The texts of the kernels: how each file opens (docs/conventions.md)."""

import re
from pathlib import Path

import pytest

from clsplat.device.source import kernel_root
from clsplat.layouts.columns import header

SHARED = kernel_root() / "shared"
LABELS = ["Owner", "Launch", "Buffers", "Equations"]
FILES = sorted(kernel_root().glob("*.cl"))


def opening(path: Path) -> list[str]:
    lines = path.read_text(encoding="utf-8").splitlines()
    return lines[: next(i for i, line in enumerate(lines) if not line.startswith("//"))]


def test_the_layouts_are_those_of_python() -> None:
    written = (SHARED / "layouts.h").read_text(encoding="utf-8")
    assert written == header(), "python -m clsplat.layouts.columns > kernels/shared/layouts.h writes it anew"


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_file_opens_with_what_it_computes_its_owners_its_launch_its_buffers_and_its_equations(path: Path) -> None:
    lines = opening(path)
    assert re.match(r"// [A-Z]", lines[0])
    assert [line[3:].partition(":")[0] for line in lines if re.match(rf"// ({'|'.join(LABELS)}): ", line)] == LABELS
    assert len(lines) <= 20


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_the_pages_that_a_file_names_are_there(path: Path) -> None:
    pages = re.findall(r"docs/[\w/.-]+\.md", path.read_text(encoding="utf-8"))
    assert [page for page in pages if not (kernel_root().parent / page).is_file()] == []


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_no_item_returns_before_a_barrier(path: Path) -> None:
    """A barrier that not every item of a group reaches hangs or corrupts on real drivers."""
    for kernel in re.split(r"(?=__kernel void )", path.read_text(encoding="utf-8"))[1:]:
        before_last, barrier, _ = kernel.rpartition("BARRIER_")
        if barrier:
            assert not re.search(r"\breturn\b", before_last), kernel.splitlines()[0]
