# SPDX-License-Identifier: Apache-2.0
"""`.ci/run`: its parts, its table of steps, and its status. Steps are replaced by commands that do nothing."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest
from calls import ended

ROOT = Path(__file__).resolve().parents[2]
STEP = re.compile(r'\bstep ("[^"]+") (spare )?.*')
ROW = re.compile(r"^ *(\d+)  (.+)$", re.MULTILINE)

pytestmark = pytest.mark.skipif(os.name != "posix" or shutil.which("bash") is None, reason="bash is not there")


def ran(folder: Path, *arguments: str, **steps: str) -> subprocess.CompletedProcess[str]:
    """The script in a folder that holds nothing else; steps: commands by the names of steps, otherwise `true`."""

    def stub(found: re.Match[str]) -> str:
        name = found[1].strip('"')
        command = steps.get(name, "eval python=python3" if name == "environment" else "true")
        return f"step {found[1]} {found[2] or ''}{command}"

    script = folder / ".ci/run"
    script.parent.mkdir()
    script.write_text(STEP.sub(stub, (ROOT / ".ci/run").read_text()).replace("\n    inherit\n", "\n"))
    variables = {**os.environ, "TMPDIR": str(folder)}
    result = ended("bash", script, *arguments, env=variables)
    assert [path.name for path in folder.iterdir()] == [".ci"]
    shutil.rmtree(script.parent)
    return result


def rows(output: str) -> list[str]:
    """Names of the steps in the table."""
    return [name for _, name in ROW.findall(output.partition("\nseconds  step\n")[2])]


def test_the_parts_have_every_step_once(tmp_path: Path) -> None:
    quick, full, both = (ran(tmp_path, *arguments) for arguments in (["quick"], ["full"], []))
    assert {quick.returncode, full.returncode, both.returncode} == {0}
    assert [line.rpartition(",")[0] for line in (quick.stdout.splitlines()[-1], full.stdout.splitlines()[-1])] == [
        "== all passed: quick",
        "== all passed: full",
    ]
    assert both.stdout.splitlines()[-1].startswith("== all passed: quick full, ")
    names = [found[1] for found in STEP.finditer((ROOT / ".ci/run").read_text())]
    assert set(rows(quick.stdout)) & set(rows(full.stdout)) == {"environment", "in all"}
    assert rows(both.stdout) == rows(quick.stdout)[:-1] + rows(full.stdout)[1:]
    assert {f'"{name}"' for name in rows(both.stdout)} == {*names, '"in all"'}


def test_the_first_failure_ends_the_run_with_the_table(tmp_path: Path) -> None:
    result = ran(tmp_path, **{"ruff format": "bash -c 'exit 7'"})
    assert result.returncode == 1 and "all passed" not in result.stdout
    before = ["newcomer: clone", "newcomer: tools/demo", "environment", "ruff check"]
    assert rows(result.stdout) == [*before, "ruff format (failed)", "in all"]
    assert "== FAILED: ruff format (status 7 after " in result.stderr


def test_a_step_beside_others_fails_where_it_is_waited_for(tmp_path: Path) -> None:
    result = ran(tmp_path, mypy="bash -c 'echo an error; exit 7'")
    assert result.returncode == 1 and "all passed" not in result.stdout
    assert rows(result.stdout)[-3:] == ["newcomer: tools/test", "mypy (failed)", "in all"]
    assert "an error" in result.stdout.splitlines() and "== FAILED: mypy (status 7 after " in result.stderr


def test_a_step_is_beside_several_others_at_the_lowest_priority(tmp_path: Path) -> None:
    result = ran(tmp_path, "full", **{"memory; GPUs, counted": "bash -c 'nice; sleep 0.2'", "wheel": "nice"})
    assert rows(result.stdout)[1:-1] == [
        *("analysers", "OpenCL drivers", "wheel", "browser", "other readers", "torch"),
        *("tests", "memory; GPUs, counted", "machines", "digests"),
    ]
    assert re.search(r"^== memory; GPUs, counted, begun before\n19$", result.stdout, re.MULTILINE)
    assert re.search(rf"^== wheel, begun before\n{os.nice(0)}$", result.stdout, re.MULTILINE)


def test_a_step_beside_others_ends_with_the_run(tmp_path: Path) -> None:
    process = tmp_path.with_suffix(".process")
    begun = f"while [ ! -s {process} ]; do sleep 0.01; done; exit 7"
    beside = f"bash -c 'echo $$ >{process}; sleep 600; true'"
    result = ran(tmp_path, **{"environment": beside, "newcomer: tools/demo": f"bash -c '{begun}'"})
    assert result.returncode == 1 and rows(result.stdout)[-2:] == ["newcomer: tools/demo (failed)", "in all"]
    with pytest.raises(ProcessLookupError):
        _wait_until_gone(int(process.read_text()))


def _wait_until_gone(process: int, seconds: float = 10) -> None:
    """Raises ProcessLookupError once there is no such process."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        os.kill(process, 0)
        time.sleep(0.01)


@pytest.mark.parametrize(("command", "status"), [("exit 0", 0), ("exit 3", 3), ("kill -TERM $$", -signal.SIGTERM)])
def test_a_run_that_is_cut_off_says_in_which_step(tmp_path: Path, command: str, status: int) -> None:
    result = ran(tmp_path, "full", browser=command)
    assert result.returncode == status and "all passed" not in result.stdout
    assert rows(result.stdout) == [
        *("environment", "analysers", "OpenCL drivers", "wheel", "browser (did not end)", "in all")
    ]


def test_its_processes_keep_what_python_compiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    result = ran(tmp_path, "full", torch="bash -c 'echo kept=${PYTHONDONTWRITEBYTECODE:-yes}'")
    assert result.returncode == 0 and "kept=yes" in result.stdout.splitlines()


@pytest.mark.parametrize("arguments", [["all"], ["quick", "full"], ["--quick"]])
def test_other_arguments_are_refused(tmp_path: Path, arguments: list[str]) -> None:
    result = ran(tmp_path, *arguments)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr == f"usage: bash .ci/run [quick|full], but the arguments are: {' '.join(arguments)}\n"


def test_help_is_what_the_script_opens_with(tmp_path: Path) -> None:
    result = ran(tmp_path, "--help")
    assert result.returncode == 0
    assert result.stdout.startswith("All that a change must pass") and "bash .ci/run quick " in result.stdout
