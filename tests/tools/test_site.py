# SPDX-License-Identifier: Apache-2.0
"""tools/ci/site.py: what it adds to the pages, and that it ends with an error where one of them is wrong."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from calls import python

ROOT = Path(__file__).resolve().parents[2]
PAGES = ("README.md", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "SECURITY.md")
pytestmark = [pytest.mark.slow, pytest.mark.needs("mkdocs")]


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """Sources of the site, to be changed."""
    for name in ("clsplat", "docs", ".github"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "tools" / "ci").mkdir(parents=True)
    for name in (*PAGES, "LICENSE", "tools/ci/site.py"):
        shutil.copyfile(ROOT / name, tmp_path / name)
    return tmp_path


def build(root: Path) -> subprocess.CompletedProcess[str]:
    """The site of a copy, in its `out`."""
    return python(root / "tools/ci/site.py", root / "out", timeout=240)


def test_pages_have_docstrings_examples_formulas_and_decisions(copy: Path) -> None:
    done = build(copy)
    assert (done.returncode, done.stderr) == (0, "")
    pages = {path.relative_to(copy / "out").as_posix(): path.read_text("utf-8") for path in copy.glob("out/**/*.html")}
    assert 'id="clsplat.rasterize"' in pages["docs/api.html"]
    assert pages["docs/examples.html"].count("SPDX-License-Identifier") == 5
    assert pages["docs/cameras.html"].count("<math") > 50 and "arithmatex" not in pages["docs/cameras.html"]
    assert pages["docs/decisions/index.html"].count('href="00') >= len(list((ROOT / "docs/decisions").glob("*.md")))
    # a link to a page became one to its HTML; one to a folder of pages, to the page that stands for the folder
    assert [name for name, text in pages.items() if re.search(r'href="(?!\w+:)[^"]*\.md["#]', text)] == []
    assert 'href="decisions/index.html"' in pages["docs/architecture.html"]
    assert not (copy / "docs/decisions/README.md").exists()


@pytest.mark.parametrize(
    "wrong",
    [
        {
            "[page](nowhere.md)": "the target 'docs/nowhere.md' is not found",
            "[place](render.md#nowhere)": "does not contain an anchor '#nowhere'",
            "[code](../clsplat/nowhere.py)": "the target 'clsplat/nowhere.py' is not found",
        },
        {"::: clsplat.nowhere": "clsplat.nowhere could not be found"},
    ],
    ids=["links", "docstrings"],
)
def test_what_leads_nowhere_is_an_error(copy: Path, wrong: dict[str, str]) -> None:
    with (copy / "docs/examples.md").open("a", encoding="utf-8") as page:
        page.write("".join(f"\n{line}\n" for line in wrong))
    done = build(copy)
    assert done.returncode == 1
    assert [message for message in wrong.values() if message not in done.stderr] == []
    assert len(wrong) == 1 or f"Aborted with {len(wrong)} warnings" in done.stderr
