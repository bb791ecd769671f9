# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import rooms
from calls import python
from needs import require

from clsplat.device.source import kernel_root

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]
TEMPLATES = ("base.html", "chart.html", "compare.html", "page.js", "report.html", "style.css")
FOUND = "from clsplat.device.source import kernel_root; print(kernel_root())"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built in the environment at hand: no network."""
    require("hatchling")
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    (path,) = folder.glob("*.whl")
    return path


def test_wheel_has_every_kernel_and_module_and_nothing_else(wheel):
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    kernels = {path.relative_to(ROOT).as_posix() for path in (ROOT / "kernels").rglob("*") if path.is_file()}
    modules = {path.relative_to(ROOT).as_posix() for path in (ROOT / "clsplat").rglob("*.py")}
    assert kernels
    assert {f"clsplat/{name}" for name in kernels} <= names
    templates = {f"clsplat/report/templates/{name}" for name in TEMPLATES}
    files = {"clsplat/py.typed", "clsplat/selftest/digests.json"} | templates
    assert names == {f"clsplat/{name}" for name in kernels} | modules | files


def test_kernels_hold_no_python():
    # hatchling refuses an editable install where a rewritten path holds Python
    assert not list((ROOT / "kernels").rglob("*.py"))


def test_wheel_metadata(wheel):
    archive = zipfile.ZipFile(wheel)
    (metadata,) = (name for name in archive.namelist() if name.endswith("/METADATA"))
    text = archive.read(metadata).decode()
    assert "License-Expression: Apache-2.0" in text
    (entries,) = (name for name in archive.namelist() if name.endswith("/entry_points.txt"))
    assert "clsplat = clsplat.__main__:main" in archive.read(entries).decode()
    assert any(name.endswith("/licenses/LICENSE") for name in archive.namelist())


def test_kernels_are_found_from_a_wheel(wheel, tmp_path):
    zipfile.ZipFile(wheel).extractall(tmp_path)
    # -I: neither the checkout in the working folder nor PYTHONPATH; site-packages still has what clsplat needs
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); {FOUND}"
    found = python("-I", "-c", code, cwd=tmp_path)
    assert found.returncode == 0, found.stderr
    assert Path(found.stdout.strip()) == tmp_path / "clsplat/kernels"


def test_kernels_are_found_from_the_checkout():
    assert kernel_root() == ROOT / "kernels"


@pytest.mark.skipif(os.name != "posix", reason="files have a mode that says so on POSIX")
def test_scripts_can_be_run():
    for name in ("tools/demo", "tools/test", ".ci/run"):
        path = ROOT / name
        assert path.stat().st_mode & 0o111, f"{name} is not executable"
        assert path.read_text().startswith("#!/usr/bin/env ")


def test_the_hosted_workflow_runs_what_the_package_says_it_supports() -> None:
    yaml = pytest.importorskip("yaml", reason="the extra `test` brings it")
    requirement = pytest.importorskip("packaging.specifiers")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    workflow = yaml.safe_load((ROOT / ".github/workflows/test.yml").read_text("utf-8"))
    (job,) = workflow["jobs"].values()
    matrix = job["strategy"]["matrix"]
    pythons = matrix["python"]
    assert all(isinstance(python, str) for python in pythons)  # 3.10 is a number that ends in 1 otherwise
    assert [system.partition("-")[0] for system in matrix["system"]] == ["ubuntu", "macos", "windows"]
    named = [line.rpartition(" ")[2] for line in project["classifiers"] if "Python :: 3." in line]
    allowed = requirement.SpecifierSet(project["requires-python"])
    assert {python for python in named if python not in allowed} == set()
    oldest, newest = (min(named, key=_number), max(named, key=_number))
    assert (pythons[0], pythons[-1]) == (oldest, newest)
    assert set(pythons) <= set(named)
    assert f"3.{_number(oldest) - 1}" not in allowed
    commands = [step["run"] for step in job["steps"] if "run" in step]
    assert [line for line in commands if line.startswith("python tools/demo ")]
    assert commands[-1] == "python tools/test"
    names = {step["name"] for step in job["steps"] if "if" in step}
    assert names == {"OpenCL driver on macOS", "OpenCL driver on Windows"}


def test_the_hosted_site_is_published_by_its_owner_alone() -> None:
    yaml = pytest.importorskip("yaml", reason="the extra `test` brings it")
    workflow = yaml.safe_load((ROOT / ".github/workflows/site.yml").read_text("utf-8"))
    build, publish = workflow["jobs"]["build"], workflow["jobs"]["publish"]
    assert workflow["permissions"] == {"contents": "read"} and "permissions" not in build
    assert publish["permissions"] == {"pages": "write", "id-token": "write"}
    assert publish["if"].startswith("vars.PUBLISH_SITE == 'yes' && ") and publish["needs"] == "build"
    uses = [step["uses"] for job in (build, publish) for step in job["steps"] if "uses" in step]
    assert [name for name in uses if "pages" in name] == ["actions/upload-pages-artifact@v4", "actions/deploy-pages@v4"]
    (upload,) = (step for step in build["steps"] if "pages" in step.get("uses", ""))
    commands = [step["run"] for step in build["steps"] if "run" in step]
    assert commands[-1] == f".venv/bin/python tools/ci/site_versions.py {upload['with']['path']}"


def test_hosted_linters_and_those_of_a_commit_are_those_of_ci() -> None:
    yaml = pytest.importorskip("yaml", reason="the extra `test` brings it")
    (job,) = yaml.safe_load((ROOT / ".github/workflows/lint.yml").read_text("utf-8"))["jobs"].values()
    commands = {step["run"].removeprefix(".venv/bin/") for step in job["steps"] if ".venv" in step.get("run", "")}
    text = (ROOT / ".ci/run").read_text("utf-8")
    for words in ('"$python" -m ', '"${python%/*}/', '"'):
        text = text.replace(words, "")
    assert len(commands) == 5 and {command for command in commands if f" {command}\n" not in text} == set()
    extra = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]["dev"]
    (here,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text("utf-8"))["repos"]
    assert {name for hook in here["hooks"] for name in hook["additional_dependencies"]} < set(extra)
    assert {hook["entry"].split()[0] for hook in here["hooks"]} < {command.split()[0] for command in commands}


def test_the_citation_has_the_version_of_the_package() -> None:
    yaml = pytest.importorskip("yaml", reason="the extra `test` brings it")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert [citation[key] for key in ("title", "version", "license")] == [
        project[key] for key in ("name", "version", "license")
    ]


def _number(python: str) -> int:
    return int(python.partition(".")[2])


def test_the_table_of_rooms_is_that_of_the_contracts() -> None:
    assert (ROOT / "docs/architecture.md").read_text("utf-8") == rooms.page(), "tools/ci/rooms.py --write"
    assert {path.parent.name for path in (ROOT / "clsplat").glob("*/__init__.py")} < set(rooms.orders()[""])


def test_the_page_of_tools_names_every_tool() -> None:
    text = (ROOT / "docs/tools.md").read_text("utf-8")
    rows = re.findall(r"^\| (`.*?) \|", text, re.MULTILINE)
    named = {name for row in rows for name in re.findall(r"`(?:hooks/)?([\w.]+)", row)}
    tools = (path for path in (ROOT / "tools").rglob("*") if path.is_file() and path.suffix != ".pyc")
    assert named == {path.name for path in tools}
