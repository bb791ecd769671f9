# SPDX-License-Identifier: Apache-2.0
"""capture.json: which folders a capture takes, and which results of an earlier call it keeps."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from calls import refuses

from clsplat.capture.folder import CaptureFolder
from clsplat.config.training import TrainConfig
from clsplat.runs.run import Run
from clsplat.scenes.sfm.captured_files import CAPTURE_RECORD_FILE

ASKED = {"input": ["/a/walk.mp4"], "iterations": 30}


@pytest.fixture
def folder(tmp_path: Path) -> CaptureFolder:
    found = CaptureFolder(tmp_path)
    found.claim(ASKED, "capture")
    return found


def filled(folder: CaptureFolder, source: str) -> None:
    """Begin all stages with this source, and write their results."""
    for stage, result in folder.results.items():
        folder.begin(stage, source)
        if stage == "training":
            Run.create(result, TrainConfig(), overwrite=True)
            (result / "model.ply").write_bytes(b"model")
        elif result.suffix:
            result.write_bytes(b"result")
        else:
            result.mkdir(exist_ok=True)
            (result / "file").write_bytes(b"result")


def files_of(folder: CaptureFolder) -> set[str]:
    """Names of the files in the folder, without the record."""
    files = (path for path in folder.path.rglob("*") if path.is_file())
    return {path.relative_to(folder.path).as_posix() for path in files} - {CAPTURE_RECORD_FILE}


@pytest.mark.parametrize("name", ["frames", "scene", "run", "turntable", "report.html", "thumbnail.png"])
def test_results_without_a_record_are_somebody_elses(name: str, tmp_path: Path) -> None:
    (tmp_path / name).mkdir()
    folder = CaptureFolder(tmp_path)
    for overwrite in (False, True):
        refuses(
            f"holds {name}, which the capture did not create .* choose another folder",
            folder.claim,
            ASKED,
            "capture",
            overwrite=overwrite,
        )
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_other_files_do_not_matter(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    CaptureFolder(tmp_path).claim(ASKED, "capture")
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_another_call_is_refused_and_changes_nothing(folder: CaptureFolder) -> None:
    filled(folder, "a")
    before = {path: path.read_bytes() for path in folder.path.rglob("*") if path.is_file()}
    message = refuses("was made with", folder.claim, {**ASKED, "iterations": 60}, "capture")
    expected = "was made with iterations 30, not with iterations 60; choose another folder, or give --overwrite to"
    assert expected in message
    message = refuses("was made with", folder.claim, {**ASKED, "input": ["/b/x", "/b/y"]}, "capture")
    assert "was made with input /a/walk.mp4, not with input /b/x, /b/y;" in message
    assert {path: path.read_bytes() for path in folder.path.rglob("*") if path.is_file()} == before


def test_the_same_call_keeps_everything(folder: CaptureFolder) -> None:
    filled(folder, "a")
    before = files_of(folder)
    folder.claim(ASKED, "capture")
    for stage in folder.results:
        folder.begin(stage, "a")
    assert files_of(folder) == before


def test_overwriting_keeps_the_stages_whose_source_is_the_same(folder: CaptureFolder) -> None:
    filled(folder, "a")
    folder.claim({**ASKED, "iterations": 60}, "capture", overwrite=True)
    for stage in ("frames", "cameras"):
        folder.begin(stage, "a")
    folder.begin("training", "b")
    assert folder.scene.is_dir() and not (folder.run / "model.ply").exists()
    # the record has the new call, so that it goes on without --overwrite
    folder.claim({**ASKED, "iterations": 60}, "capture")


def test_overwriting_the_same_call_makes_everything_again(folder: CaptureFolder) -> None:
    filled(folder, "a")
    folder.claim(ASKED, "capture", overwrite=True)
    for stage in folder.results:
        folder.begin(stage, "a")
    assert files_of(folder) == set()


def test_files_of_others_in_a_run_stay(folder: CaptureFolder) -> None:
    filled(folder, "a")
    (folder.run / "notes.txt").write_text("mine")
    folder.begin("training", "b")
    assert {name for name in files_of(folder) if name.startswith("run/")} == {"run/notes.txt"}


def test_results_that_come_from_elsewhere_are_not_removed(folder: CaptureFolder) -> None:
    folder.scene.mkdir()
    refuses("scene: was not made by this capture; choose another folder", folder.begin, "cameras", "a")
    assert folder.scene.is_dir()


def test_a_call_without_results_can_be_mended(folder: CaptureFolder) -> None:
    folder.begin("frames", "a")
    folder.claim({**ASKED, "input": ["/a/right.mp4"]}, "capture")
    assert folder.asked()["input"] == ["/a/right.mp4"]


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"asked": {}}', '{"asked": 1, "made": {}}', "\x00"])
def test_a_broken_record_is_named(text: str, folder: CaptureFolder) -> None:
    filled(folder, "a")
    folder.record_path.write_text(text)
    refuses(CAPTURE_RECORD_FILE, folder.claim, ASKED, "capture", overwrite=True)
    assert folder.record_path.read_text() == text


def test_the_record_says_what_was_asked(folder: CaptureFolder) -> None:
    folder.begin("cameras", "a")
    record = json.loads(folder.record_path.read_text())
    assert (record["asked"], record["made"]) == (ASKED, {"cameras": "a"})
    assert folder.asked() == ASKED
    assert CaptureFolder(folder.path / "other").asked() == {}
