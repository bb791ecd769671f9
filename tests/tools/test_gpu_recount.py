# SPDX-License-Identifier: Apache-2.0
"""Inputs of measured steps, counted anew in the code that was measured."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gpu_recount
import pytest
from calls import refuses
from gpu_compilers import TEXTS, Source
from gpu_loops import rules_of
from gpu_measured import CALIBRATION, read
from gpu_model import Work
from gpu_recount import launches_in, older_code, recount
from gpu_rules import BY_ITEM, EVERYWHERE
from gpu_rules_measured import MEASURED
from gpu_static import FRAMES

from clsplat.errors import ClsplatError


@pytest.mark.slow
def test_older_code_and_its_launches(tmp_path: Path) -> None:
    older_code("HEAD", tmp_path)
    (frame,) = [each for each in json.loads(FRAMES.read_text())["frames"] if each["name"] == "fox-like"]
    ((*_, last),) = launches_in(tmp_path, "HEAD", "1x64", [frame])
    assert last["commit"] == "HEAD"
    source = Source.of(last)
    assert source.lines == TEXTS["HEAD", "density"].splitlines()
    assert source.used.commit == "HEAD", "kernels of another text are compiled apart"
    assert "density_statistics(" in source.text


def test_a_commit_that_the_history_lacks(tmp_path: Path) -> None:
    refuses(
        "commit 0123abcd of docs/gpus/calibration.json: git archive says .*whole clone",
        older_code,
        "0123abcd",
        tmp_path,
        error=ClsplatError,
    )


def test_every_scene_gets_the_inputs_of_its_code(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scene's counts replace its frame's; `counted` names the code where `commit` has no tool for it."""
    asked: list[Any] = []

    def launches(folder: Path, commit: str, shape: str, frames: Sequence[Mapping[str, Any]]) -> list[Any]:
        asked.append((commit, shape, list(frames)))
        return [[commit, frame["name"]] for frame in frames]

    monkeypatch.setattr(gpu_recount, "older_code", lambda commit, folder: None)
    monkeypatch.setattr(gpu_recount, "launches_in", launches)
    scenes: list[dict[str, Any]] = [
        {"scene": "a", "frame": "f", "counts": {"reached": 5}},
        {"scene": "b", "frame": "g", "inputs": ["older"]},
        {"scene": "c", "frame": "of no row", "inputs": ["kept"]},
    ]
    rows = [{"gpu": "H200", "commit": "old", "counted": "older", "shape": "1x64", "scenes": scenes}]
    frames = [{"name": "f", "reached": 3, "taken": 2}, {"name": "g"}]
    recount(rows, frames, lambda step, target, frame: [*step, target, frame.get("reached")])
    assert asked == [("older", "1x64", [{"name": "f", "reached": 5, "taken": 2}, {"name": "g"}])]
    inputs = [scene["inputs"] for scene in scenes]
    assert inputs == [["older", "f", "sm_90", 5], ["older", "g", "sm_90", None], ["kept"]]


def test_rules_of_the_kernels_that_were_measured() -> None:
    commit = "5ea10cd9"
    assert rules_of("blend", commit) == MEASURED[commit]["blend"] + EVERYWHERE
    assert rules_of("ranges", commit) == BY_ITEM["ranges"] + EVERYWHERE, "as in the present kernels"
    counted = {row.get("counted", row["commit"]) for row in json.loads(CALIBRATION.read_text())}
    assert set(MEASURED) <= counted, "rules of kernels that no row has are to go"


def test_defaults_are_left_out_of_a_row() -> None:
    (row, *_) = json.loads(CALIBRATION.read_text())
    fill = next(each for each in row["scenes"][0]["inputs"] if each and each["kernel"] == "fill")
    assert set(fill) == {"stage", "bytes", "kernel"}
    ((one, *_), _) = read([row], {})
    assert Work("ranges", fill["bytes"], kernel="fill") in one.works
