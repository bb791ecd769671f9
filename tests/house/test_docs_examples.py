# SPDX-License-Identifier: Apache-2.0
"""Code in README.md and docs/: the blocks with prompts and the examples run, and every public name has its place."""

from __future__ import annotations

import ast
import doctest
import os
import re
import shutil
from pathlib import Path

import pytest
from calls import python
from test_docs import PAGES, ROOT

import clsplat

PROMPTS = re.compile(r"^```pycon\n(.*?)^```", re.MULTILINE | re.DOTALL)
WITH_PROMPTS = [page for page in PAGES if PROMPTS.search(page.read_text("utf-8"))]
LIMITS = {"fit_image": 30.0, "train_scene": 16.0, "pose": 0.01, "lift_features": 90.0, "depth_loss": 0.01}
"""Bounds of the first number that each example prints: dB, dB, error of a motion of 0.30, percent, and error of
depths that are 0.5 off at first."""
SMALLER = {"pose", "depth_loss"}
"""Those whose number is an error."""


@pytest.fixture
def beside_a_scene(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A working folder with a small scene in `scene`."""
    shutil.copytree(scene, tmp_path / "scene")
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("page", WITH_PROMPTS, ids=lambda page: page.name)
@pytest.mark.usefixtures("beside_a_scene")
def test_blocks_with_prompts_give_what_they_show(page: Path) -> None:
    text = "".join(PROMPTS.findall(page.read_text("utf-8")))
    test = doctest.DocTestParser().get_doctest(text, {}, page.name, str(page), 0)
    report: list[str] = []
    result = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test, out=report.append)
    assert result.attempted > 10 and result.failed == 0, "".join(report)


@pytest.mark.usefixtures("beside_a_scene")
def test_the_block_of_the_readme_runs() -> None:
    (code,) = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text("utf-8"), re.MULTILINE | re.DOTALL)
    assert "iterations=7000" in code
    exec(code.replace("iterations=7000", "iterations=5"), {})
    assert Path("model.ply").is_file()


@pytest.mark.slow
@pytest.mark.needs("torch")
@pytest.mark.parametrize("name", LIMITS)
def test_an_example_does_what_it_says(name: str, tmp_path: Path) -> None:
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path}
    done = python(ROOT / f"docs/examples/{name}.py", cwd=tmp_path, env=environment, timeout=240)
    assert done.returncode == 0, done.stderr
    number = float(re.findall(r"[\d.]+", done.stdout)[0])
    assert number < LIMITS[name] if name in SMALLER else number > LIMITS[name], done.stdout


def test_every_example_is_on_its_page() -> None:
    names = {path.stem for path in (ROOT / "docs/examples").iterdir()}
    text = (ROOT / "docs/examples.md").read_text("utf-8")
    assert (
        names
        == set(LIMITS)
        == set(re.findall(r"^\[docs/examples/\w+\.py\]\(examples/(\w+)\.py\)$", text, re.MULTILINE))
    )


def names_of(module: str) -> set[str]:
    """`__all__` of a package whose dependencies may be missing."""
    tree = ast.parse((ROOT / module / "__init__.py").read_text("utf-8"))
    lists = [
        node.value for node in tree.body if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
    ]
    return set(ast.literal_eval(lists[0]))


def test_the_api_page_has_every_public_name() -> None:
    text = (ROOT / "docs/api.md").read_text("utf-8")
    named = set(re.findall(r"^::: ([\w.]+)$", text, re.MULTILINE))
    public = {f"clsplat.{name}" for name in clsplat.__all__ if name != "__version__"}
    for part in ("torch", "jax"):
        public |= {f"clsplat.{part}.{name}" for name in names_of(f"clsplat/{part}")}
    assert {name for name in public - named if name not in text} == set()


def test_every_page_is_in_the_contents_of_the_site() -> None:
    listed = re.findall(r"(?:- |: )([\w./-]+\.md)$", (ROOT / "docs/mkdocs.yml").read_text("utf-8"), re.MULTILINE)
    assert len(listed) == len(set(listed))
    pages = {page.relative_to(ROOT).as_posix() for page in PAGES if page.parent.name != "decisions"}
    assert set(listed) == pages | {"CHANGELOG.md"}
