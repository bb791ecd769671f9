# SPDX-License-Identifier: Apache-2.0
"""Blocks by the templates in docs/farm: Open Job Description, a Slurm array, and what Kubernetes would run."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import yaml
from needs import openjd_path, require
from slurm_node import slurm_node, wait_for_jobs
from systems import posix

from clsplat.cli.main import main, parse

FARM = Path(__file__).resolve().parents[2] / "docs" / "farm"
OPENJD, SLURM, KUBERNETES = (FARM / f"clsplat-blocks.{name}" for name in ("openjd.yaml", "slurm.sh", "kubernetes.yaml"))
SETTINGS = ["--iterations", "40"]


@pytest.fixture(scope="module")
def planned(tmp_path_factory: pytest.TempPathFactory, small_scene: Path) -> Path:
    """A city whose plan was made by the command. Tests copy it, so that only the blocks are trained again."""
    city = tmp_path_factory.mktemp("templates") / "city"
    assert main(["blocks", "plan", str(small_scene), "-o", str(city), "--blocks", "2", *SETTINGS]) == 0
    return city


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, planned: Path) -> dict[str, bytes]:
    """The models that the commands make in one process, block by block."""
    city = shutil.copytree(planned, tmp_path_factory.mktemp("whole") / "city")
    for words in (["train", "--block", "1,0"], ["train", "--block", "0,0"], ["merge"], ["finish"]):
        assert main(["blocks", words[0], str(city), *words[1:]]) == 0
    return models(city)


def models(city: Path) -> dict[str, bytes]:
    """The bytes of all models of a city, by path."""
    paths = [*city.glob("blocks/*/model.ply"), city / "merged.ply", city / "model.ply"]
    return {str(path.relative_to(city)): path.read_bytes() for path in paths}


@pytest.fixture
def command(tmp_path: Path) -> Path:
    """This Python's clsplat as a program, in a folder whose name has a space."""
    path = tmp_path / "a bin" / "clsplat"
    path.parent.mkdir()
    path.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m clsplat "$@"\n')
    path.chmod(0o755)
    return path


@pytest.mark.slow
@posix
def test_open_job_description(
    small_scene: Path, planned: Path, whole: dict[str, bytes], command: Path, tmp_path: Path
) -> None:
    require("openjd")
    city = shutil.copytree(planned, tmp_path / "city")
    checked = subprocess.run([str(openjd_path()), "check", str(OPENJD)], capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stdout + checked.stderr
    values = {"Scene": small_scene, "City": city, "Blocks": 2, "BlockNumbers": "0-2", "Iterations": 40}
    line = [str(openjd_path()), "run", str(OPENJD), "--step", "Finish", "--run-dependencies"]
    line += [word for name, value in {**values, "Clsplat": command}.items() for word in ("-p", f"{name}={value}")]
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert models(city) == whole
    assert done.stdout.count("openjd_progress: 100.0") == 3  # two blocks and the finish
    assert f"{city}: the plan has 2 blocks, so there is nothing to do" in done.stdout


@pytest.mark.slow
@pytest.mark.needs("slurm")
def test_a_slurm_array(
    small_scene: Path, planned: Path, whole: dict[str, bytes], command: Path, tmp_path: Path
) -> None:
    """On a node with two slots, which train both blocks at the same time."""
    city = shutil.copytree(planned, tmp_path / "a city")
    folder = Path(tempfile.mkdtemp(prefix="slurm-", dir="/tmp"))
    environment = {"BLOCKS": "2", "COUNT": "3", "CLSPLAT": str(command)}
    try:
        with slurm_node(folder) as slurm:
            line = ["sh", str(SLURM), str(small_scene), str(city), *SETTINGS]
            environment = {**slurm, **environment}
            done = subprocess.run(line, env=environment, capture_output=True, text=True, check=False, timeout=60)
            assert done.returncode == 0, done.stderr
            assert wait_for_jobs(slurm, 300)
            logs = {path.name: path.read_text() for path in (city / "jobs").glob("slurm-*.log")}
            assert (city / "model.ply").exists(), logs
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    assert models(city) == whole
    assert sum("the plan has 2 blocks, so there is nothing to do" in text for text in logs.values()) == 1


def test_what_kubernetes_runs() -> None:
    """Each job's command is one of clsplat's, in their order; blocks are numbered by the pod's index."""
    jobs = list(yaml.safe_load_all(KUBERNETES.read_text()))
    assert [job["metadata"]["labels"]["step"] for job in jobs] == ["plan", "blocks", "merge", "finish"]
    commands = [job["spec"]["template"]["spec"]["containers"][0]["command"] for job in jobs]
    names = []
    for command in commands:
        words = command
        if command[0] == "sh":
            words = command[2].replace('"$JOB_COMPLETION_INDEX"', "3").removeprefix("exec ").split()
        assert words[0] == "clsplat"
        names.append(type(parse(words[1:])).__name__)
    assert names == ["BlocksPlanVerb", "BlocksTrainVerb", "BlocksMergeVerb", "BlocksFinishVerb"]
    assert jobs[1]["spec"]["completionMode"] == "Indexed"
    assert "--blocks, 2x2" in KUBERNETES.read_text() and jobs[1]["spec"]["completions"] == 5


def test_a_block_of_kubernetes_is_repeated() -> None:
    """Kubernetes refuses a limit for each index, and a policy for failed pods, with another restart policy."""
    jobs = list(yaml.safe_load_all(KUBERNETES.read_text()))
    for spec in (job["spec"] for job in jobs):
        if "backoffLimitPerIndex" in spec or "podFailurePolicy" in spec:
            assert spec["template"]["spec"]["restartPolicy"] == "Never"
    assert jobs[1]["spec"]["backoffLimitPerIndex"] == 3
    rule = {"action": "Ignore", "onPodConditions": [{"type": "DisruptionTarget"}]}
    assert jobs[1]["spec"]["podFailurePolicy"] == {"rules": [rule]}


@posix
@pytest.mark.parametrize(
    ("last", "status", "steps"), [("Complete", 0, ["plan", "blocks", "merge", "finish"]), ("Failed", 1, ["plan"])]
)
def test_how_kubernetes_is_waited_for(tmp_path: Path, last: str, status: int, steps: list[str]) -> None:
    """The loop of the template's head waits until a Job is complete, and ends when it has failed."""
    lines = [line.removeprefix("#     ") for line in KUBERNETES.read_text().splitlines() if line.startswith("#     ")]
    calls = tmp_path / "calls"
    stubs = f"""
        sleep() {{ touch {tmp_path}/slept; }}
        kubectl() {{
            if [ "$1" = apply ]; then echo "$5" >> {calls}; rm -f {tmp_path}/slept; return; fi
            if [ -e {tmp_path}/slept ]; then echo "FailureTarget {last}"; fi
        }}
    """
    line = ["sh", "-c", stubs + "\n".join(lines)]
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=30)
    assert done.returncode == status
    assert calls.read_text().split() == [f"step={step}" for step in steps]
    assert done.stderr == ("" if status == 0 else "clsplat-plan: not complete, state: FailureTarget Failed\n")


def test_slurm_signals_the_command() -> None:
    """Without "B:" the signal goes to job steps, of which these jobs have none."""
    assert "--signal=B:TERM@120" in SLURM.read_text()


def test_the_number_of_a_block(
    planned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A number beyond the last block is no error, a name is."""
    begun: list[str] = []

    def note(city: Path, name: str, *_: object) -> bool:
        begun.append(name)
        return False

    monkeypatch.setattr("clsplat.blocks.block_training.train_block", note)
    city = str(planned)
    assert main(["blocks", "train", city, "--block", "1"]) == 0
    assert begun == ["1,0"]
    capsys.readouterr()
    assert main(["blocks", "train", city, "--block", "2"]) == 0
    assert capsys.readouterr().err == f"{city}: the plan has 2 blocks, so there is nothing to do\n"
    assert begun == ["1,0"]
