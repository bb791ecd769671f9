# SPDX-License-Identifier: Apache-2.0
"""`clsplat capture` from its input to its pictures, interrupted in each stage, and with wrong input.

Structure from motion is replaced by a scene with known cameras, except in slow tests.
"""

from __future__ import annotations

import json
import shlex
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from calls import Capture, error_line, printed, raising, rejected
from scipy import ndimage
from tiny import write_scene
from walk_videos import write_walk

from clsplat.capture import pipeline, run
from clsplat.capture.progress import CaptureProgress
from clsplat.cli.main import main
from clsplat.errors import ClsplatError, InputError
from clsplat.images.reading import read_image
from clsplat.images.video import video_missing

STAGES = ("frames", "cameras", "training", "report", "thumbnail", "turntable")
STEPS = 12
"""Training steps."""
FRAMES = 3
"""Frames of the turntable."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result of structure from motion: the cameras and points of a small scene."""
    folder = write_scene(tmp_path_factory.mktemp("sfm") / "scene")
    (folder / "sfm.json").write_text('{"fingerprint": "a"}')
    return folder


@pytest.fixture(autouse=True)
def known_cameras(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace structure from motion, and make the turntable short."""

    def reconstruct(
        photographs: Path, output: Path, settings: object, *, progress: Callable[..., None], **_: object
    ) -> Path:
        progress("finding features", 0.5)
        if not output.exists():
            shutil.copytree(scene, output)
        return output

    monkeypatch.setattr(pipeline, "reconstruct", reconstruct)
    monkeypatch.setattr(run, "CAPTURE_TURNTABLE_FRAMES", FRAMES)


@pytest.fixture(scope="module")
def photographs(scene: Path) -> Path:
    return scene / "images"


def words(photographs: Path, output: Path, *more: object) -> list[str]:
    return ["capture", str(photographs), "-o", str(output), "--iterations", str(STEPS), *map(str, more)]


@pytest.fixture(scope="module")
def finished(photographs: Path, scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture that nothing has interrupted."""
    folder = tmp_path_factory.mktemp("finished") / "shot"
    with pytest.MonkeyPatch.context() as patch:
        known_cameras.__wrapped__(scene, patch)  # type: ignore[attr-defined]
        assert main(words(photographs, folder)) == 0
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    """Results of a capture that have the same bytes each time."""
    names = ("run/model.ply", "thumbnail.png", "turntable/turntable.mp4")
    files = [folder / name for name in names] + sorted(folder.glob("turntable/*.png"))
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files if path.exists()}


def test_everything_is_there(finished: Path) -> None:
    names = {path.name for path in finished.iterdir()}
    assert names == {"scene", "run", "turntable", "report.html", "thumbnail.png", "capture.json"}
    turntable = {path.name for path in (finished / "turntable").iterdir()}
    assert turntable - {"turntable.mp4"} == {f"frame_{index:03d}.png" for index in range(FRAMES)}
    assert ("turntable.mp4" in turntable) == (not video_missing())
    assert read_image(finished / "thumbnail.png").shape == (512, 512, 3)
    assert (finished / "report.html").read_bytes() == (finished / "run" / "report.html").read_bytes()
    assert json.loads((finished / "capture.json").read_text())["asked"]["iterations"] == STEPS


def test_the_last_lines_say_how_to_look_at_it(photographs: Path, tmp_path: Path, capsys: Capture) -> None:
    told = printed(capsys, words(photographs, tmp_path / "shot", "--json"))
    assert json.loads(told.out)["mean"]["psnr"] > 0
    lines = told.err.splitlines()
    first = next(index for index, line in enumerate(lines) if line.startswith("done in 0 min "))
    assert "on 2 held-out photos" in lines[first]
    assert lines[first + 1].split(None, 4) == [
        "look",
        "at",
        "the",
        "model:",
        f"clsplat view {tmp_path / 'shot' / 'run'}",
    ]
    assert any(line.startswith("inspected 10 photographs: ") for line in lines)
    for number, stage in enumerate(STAGES, 1):
        assert any(line.startswith(f"{number}/6 {stage}: ") for line in lines), stage


def test_a_second_call_uses_what_is_there(
    finished: Path, photographs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "shot"))
    before = contents(folder)
    from clsplat.capture import pictures, training

    monkeypatch.setattr(training, "train", raising(AssertionError("trains again")))
    monkeypatch.setattr(pictures, "write_image", raising(AssertionError("renders again")))
    assert "the model trained before" in printed(capsys, words(photographs, folder)).err
    assert contents(folder) == before


def interrupt(stage: str, report_number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Send Ctrl-C when a stage reports its progress for the time `report_number`, counted from 1."""
    real, heard = CaptureProgress.__call__, list[str]()

    def report(self: CaptureProgress, text: str, fraction: float | None = None, detail: str = "") -> None:
        real(self, text, fraction, detail)
        heard.append(self.stage_name)
        if heard.count(stage) == report_number:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(CaptureProgress, "__call__", report)


@pytest.mark.parametrize(
    ("stage", "report_number", "at"),
    [
        ("cameras", 1, ""),
        ("training", 3, " at step 10"),
        ("turntable", 4, ""),  # while the video is encoded
        *(
            pytest.param(*each, marks=pytest.mark.slow)
            for each in (
                ("frames", 1, ""),
                ("training", 1, ""),  # before the run exists
                ("training", 2, " before the first checkpoint"),
                ("report", 1, ""),
                ("thumbnail", 1, ""),
                ("turntable", 1, ""),
            )
        ),
    ],
)
def test_ctrl_c_and_the_same_call_again(
    stage: str,
    report_number: int,
    at: str,
    finished: Path,
    photographs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: Capture,
) -> None:
    folder = tmp_path / "shot"
    call = words(photographs, folder)
    with monkeypatch.context() as patch:
        interrupt(stage, report_number, patch)
        assert main(call) == 130
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == f"clsplat: interrupted in the stage {stage}{at}; go on with: clsplat {' '.join(call)}"
    assert not [path for path in folder.rglob(".*") if path.is_file()], "no lock and no temporary file stays"
    printed(capsys, call)
    assert contents(folder) == contents(finished)


def test_another_input_is_refused(
    finished: Path, photographs: Path, scene: Path, tmp_path: Path, capsys: Capture
) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "shot"))
    before = contents(folder)
    said = rejected(capsys, words(scene, folder))
    assert f"{folder}: was made with input {photographs.resolve()}, not with input {scene.resolve()};" in said
    said = rejected(capsys, ["capture", photographs, "-o", folder])
    assert f"iterations {STEPS}, not with iterations 7000; choose another folder, or give --overwrite" in said
    assert contents(folder) == before


def test_more_steps_keep_the_cameras(
    finished: Path, photographs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "shot"))
    call = ["capture", photographs, "-o", folder, "--iterations", STEPS + 3]
    (folder / "scene" / "kept.txt").write_text("the folder is the same")
    printed(capsys, [*call, "--overwrite"])
    assert (folder / "scene" / "kept.txt").exists()
    assert json.loads((folder / "run" / "eval.json").read_text())["step"] == STEPS + 3
    assert contents(folder).keys() == contents(finished).keys()
    assert contents(folder)["run/model.ply"] != contents(finished)["run/model.ply"]
    assert contents(folder)["thumbnail.png"] != contents(finished)["thumbnail.png"]


@pytest.mark.parametrize("stage", ["cameras", "training", "report", "turntable"])
def test_an_error_names_the_stage(
    stage: str, photographs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    places = {
        "cameras": "pipeline.reconstruct",
        "training": "training.train",
        "report": "pipeline.atomic_write",
        "turntable": "pictures.frame_planes",
    }
    error = InputError("x.jpg: is damaged") if stage in ("cameras", "training") else ClsplatError("failed")
    with monkeypatch.context() as patch:
        patch.setattr(f"clsplat.capture.{places[stage]}", raising(error))
        assert main(words(photographs, tmp_path / "shot")) == error.exit_status
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(f"clsplat: error: stage {stage}: ")
    printed(capsys, words(photographs, tmp_path / "shot"))


@pytest.mark.needs("av")
def test_a_video_and_the_command_that_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    """Its frames are taken once. Another video, or another number of frames, is another call."""
    noise = ndimage.gaussian_filter(np.random.default_rng(0).uniform(0, 1, (48, 130, 3)), (1.5, 1.5, 0))
    picture = (noise - noise.min()) / (noise.max() - noise.min())
    video = write_walk(tmp_path / "my walk.mp4", [picture[:, 3 * index : 3 * index + 64] for index in range(20)])
    folder = tmp_path / "shot"
    call = words(video, folder, "--frames", 4)
    with monkeypatch.context() as patch:
        interrupt("training", 1, patch)
        assert main(call) == 130
    again = f"clsplat capture '{video}' -o {folder} --frames 4 --iterations {STEPS}"
    assert capsys.readouterr().err.splitlines()[-1].endswith(f"go on with: {again}")
    assert len(list(folder.glob("frames/my walk.mp4/*.jpg"))) == 4
    told = printed(capsys, shlex.split(again)[1:]).err
    assert "1/6 frames: using the frames taken before 100 %" in told
    assert "frames 4, not with frames 5; choose" in rejected(capsys, words(video, folder, "--frames", 5))
    assert "frames 4, not with no frames; choose" in rejected(capsys, words(video, folder))


def test_wrong_input_is_refused_before_anything_is_written(photographs: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "shot"
    note = tmp_path / "note.txt"
    note.write_text("text")
    video = tmp_path / "a.mp4"
    video.write_bytes(b"")
    for inputs, text in (
        ([], "INPUT is missing"),
        ([tmp_path / "nowhere"], f"{tmp_path / 'nowhere'}: no such file or folder"),
        ([note], f"{note}: is a file, expected a folder of photographs or a video (.mp4 "),
        ([photographs, photographs.parent], f"{photographs}: is a folder among 2 inputs, expected a single folder, or"),
        ([video, video], f"{video}: an input is given twice"),
        ([photographs, "--frames", 0], "--frames 0: expected at least 1"),
        ([tmp_path], f"{out}: is inside the input {tmp_path}"),
    ):
        assert text in rejected(capsys, ["capture", *inputs, "-o", out])
    assert "--iterations 0: expected at least 1" in rejected(
        capsys, ["capture", photographs, "-o", out, "--iterations", 0]
    )
    assert "no such device" in rejected(capsys, ["capture", photographs, "-o", out, "--device", "nowhere"])
    assert not out.exists()
    assert main(["capture", str(photographs), "-o", str(note)]) == 2
    assert f"{note}: is a file, expected a folder" in error_line(capsys)
