# SPDX-License-Identifier: Apache-2.0
"""The recipe for conda-forge: valid for conda's reader, and with the requirements of the wheel."""

from __future__ import annotations

import hashlib
import re
import shlex
from pathlib import Path

import conda_recipe
import pytest
from needs import require

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def _reader() -> None:
    require("rattler_build")


def spoilt(folder: Path, before: str, after: str) -> Path:
    """A copy of the recipe with a text replaced."""
    text = conda_recipe.RECIPE.read_text("utf-8")
    assert before in text
    path = folder / "recipe.yaml"
    path.write_text(text.replace(before, after), "utf-8")
    return path


def test_the_recipe_has_the_requirements_of_the_wheel_on_every_system() -> None:
    assert conda_recipe.problems(conda_recipe.RECIPE, ROOT) == []
    table = conda_recipe.project(ROOT)
    document = conda_recipe.rendered(conda_recipe.RECIPE, "linux-64")
    assert f"python {table['requires-python']}" in document["requirements"]["run"]
    assert (document["about"]["summary"], document["about"]["license"]) == (table["description"], table["license"])
    (script,) = table["scripts"].items()
    assert document["build"]["python"]["entry_points"] == [" = ".join(script)]


def test_a_requirement_that_differs_is_told_by_system(tmp_path: Path) -> None:
    path = spoilt(tmp_path, "pycolmap >=4.1.1", "pycolmap >=3.0")
    message = "pycolmap has '>=3.0', expected '>=4.1.1' as in pyproject.toml"
    assert conda_recipe.problems(path, ROOT) == [f"recipe.yaml, {system}: {message}" for system in conda_recipe.SYSTEMS]
    path = spoilt(tmp_path, ", intel-opencl-rt >=2024.2", "")
    message = "intel-opencl-rt has nothing, expected '>=2024.2' as in pyproject.toml"
    assert conda_recipe.problems(path, ROOT) == [f"recipe.yaml, win-64: {message}"]


@pytest.mark.parametrize(
    ("before", "after"),
    [("schema_version: 1", "schema_version: 7"), ("noarch: python", "noarch: nothing"), ("requirements:", "needs:")],
)
def test_a_recipe_that_is_not_valid_is_refused(tmp_path: Path, before: str, after: str) -> None:
    with pytest.raises(Exception, match=r"recipe|schema|noarch|needs|expected"):
        conda_recipe.rendered(spoilt(tmp_path, before, after), "linux-64")


def test_the_test_commands_are_commands_of_clsplat() -> None:
    imports, *lines = conda_recipe.commands(conda_recipe.rendered(conda_recipe.RECIPE, "linux-64"))
    assert imports == "python -c 'import clsplat, clsplat.stages'"
    assert [shlex.split(line)[:2] for line in lines] == [
        ["clsplat", word] for word in ("--version", "doctor", "devices", "demo")
    ]


def test_the_recipe_for_upload_has_the_checksum_of_the_sdist(tmp_path: Path) -> None:
    sdist = tmp_path / "clsplat-0.1.0.tar.gz"
    sdist.write_bytes(b"sdist")
    conda_recipe.write_recipe(sdist, tmp_path / "recipe.yaml")
    (source,) = conda_recipe.rendered(tmp_path / "recipe.yaml", "linux-64")["source"]
    assert source["sha256"] == hashlib.sha256(b"sdist").hexdigest()
    assert re.fullmatch(r"https://pypi\.org/.*/clsplat-\d+\.\d+\.\d+\.tar\.gz", source["url"])
