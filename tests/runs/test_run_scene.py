# SPDX-License-Identifier: Apache-2.0
"""A run knows its scene: another one, or a changed photograph, is refused before anything is written."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import ring
import survey_files
from calls import Capture, refuses
from calls import train as command_train
from quick import quick
from tiny import FEW, write_scene

from clsplat.api import train
from clsplat.arrays import Float64
from clsplat.cli.main import main, parse
from clsplat.cli.train import TrainVerb
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError
from clsplat.images.reading import read_image
from clsplat.images.writing import write_image
from clsplat.runs import scene_record
from clsplat.runs.run import Run
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene


@pytest.fixture
def own(scene: Path, tmp_path: Path) -> Path:
    """The tiny scene, to be changed."""
    return Path(shutil.copytree(scene, tmp_path / "own"))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def resume(run: Path, scene: Path, *more: str) -> int:
    return main(["train", str(scene), "-o", str(run), "--resume", "--iterations", "4", *more])


def brighten(path: Path) -> None:
    write_image(path, np.clip(read_image(path) + np.float32(0.1), 0, 1))


def refusal(run: Path, scene: Path, capsys: Capture) -> str:
    """The one line of error; the run is as it was."""
    before = contents(run)
    capsys.readouterr()
    assert resume(run, scene) == 2
    assert contents(run) == before
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = [each for each in captured.err.splitlines() if each.startswith("clsplat: error: ")]
    assert "Traceback" not in captured.err
    return line


def test_the_same_scene_goes_on_from_anywhere(run: Path, own: Path) -> None:
    known = (run / scene_record.SCENE_RECORD_FILE_NAME).read_bytes()
    assert resume(run, own) == 0
    assert (run / scene_record.SCENE_RECORD_FILE_NAME).read_bytes() == known


def test_a_changed_photograph_is_refused(run: Path, own: Path, capsys: Capture) -> None:
    brighten(own / "images" / "03.png")
    line = refusal(run, own, capsys)
    assert f"{own}: is not the scene that {run} began with: 1 view with another photograph (03.png); expected" in line
    assert "give --accept-changes to go on" in line


def test_another_scene_is_refused_with_three_examples(run: Path, own: Path, capsys: Capture) -> None:
    for path in (own / "images").iterdir():
        brighten(path)
    line = refusal(run, own, capsys)
    assert "10 views with another photograph (00.png, 01.png, 02.png and 7 more)" in line


def test_other_names_and_cameras_are_refused(run: Path, own: Path, capsys: Capture) -> None:
    listed = own / "sparse" / "0" / "images.txt"
    lines = listed.read_text().splitlines()
    words = lines[4].split()  # the third view: its camera moved
    words[5] = str(float(words[5]) + 0.01)
    lines[4] = " ".join(words)
    lines[0] = lines[0].replace("00.png", "zz.png")
    (own / "images" / "00.png").rename(own / "images" / "zz.png")
    listed.write_text("\n".join(lines) + "\n")
    line = refusal(run, own, capsys)
    assert "1 view missing now (00.png); 1 view new (zz.png); 1 view with another camera (02.png)" in line


def test_changes_can_be_accepted(run: Path, own: Path, capsys: Capture) -> None:
    brighten(own / "images" / "03.png")
    lines = (own / "sparse" / "0" / "images.txt").read_text().splitlines()
    (own / "sparse" / "0" / "images.txt").write_text("\n".join(lines[:-2]) + "\n")  # a view less
    (own / "images" / "09.png").unlink()
    assert resume(run, own, "--accept-changes") == 0
    assert resume(run, own, "--iterations", "5") == 0, "from now on this is its scene"
    assert Run.open(run).config.iterations == 5


def test_accepting_is_for_resuming(scene: Path, tmp_path: Path, capsys: Capture) -> None:
    assert main(["train", str(scene), "-o", str(tmp_path / "new"), "--accept-changes"]) == 2
    assert "--accept-changes is for --resume" in capsys.readouterr().err


def test_another_resolution_is_not_another_scene(run: Path, own: Path) -> None:
    assert resume(run, own, "--resolution", "40") == 0
    assert resume(run, own, "--iterations", "5") == 0


def test_a_run_of_an_earlier_version_resumes_with_one_line(run: Path, own: Path, capsys: Capture) -> None:
    (run / scene_record.SCENE_RECORD_FILE_NAME).unlink()
    capsys.readouterr()
    assert resume(run, own) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if scene_record.SCENE_RECORD_FILE_NAME in line]
    assert len(told) == 1
    assert told[0].startswith(f"clsplat: warning: {run}: has no scene.json, like runs of earlier versions")
    assert (run / scene_record.SCENE_RECORD_FILE_NAME).exists()


HUGE = f'{{"views": {{}}, "points": {{"count": 1}}, "origin": [0, 0, 0], "resolution": 0, "length_unit": 1{"0" * 400}}}'
"""A record with a number that no float64 has."""


@pytest.mark.parametrize(
    "text", ["{", "[]", '{"views": {"a": {}}}', '{"views": 3, "points": {}}', pytest.param(HUGE, id="huge")]
)
def test_a_damaged_record_is_named(text: str, run: Path, own: Path, capsys: Capture) -> None:
    (run / scene_record.SCENE_RECORD_FILE_NAME).write_text(text)
    assert f"{run / scene_record.SCENE_RECORD_FILE_NAME}: is damaged" in refusal(run, own, capsys)


def test_the_digest_is_of_the_photograph(scene: Path, own: Path) -> None:
    def record(folder: Path) -> dict[str, object]:
        return scene_record.record_of(load_scene(folder), 0)

    assert json.loads(json.dumps(record(scene))) == record(own)
    with open(own / "images" / "05.png", "ab") as file:
        file.write(b"x")
    assert scene_record.differences(record(scene), record(own)) == ["1 view with another photograph (05.png)"]


def test_a_scene_of_any_size_is_compared(scene: Path) -> None:
    """Positions of 1e-7 are not all the same."""
    whole = load_scene(scene)

    def scaled(factor: float, shift: float) -> Scene:
        moved = [
            replace(view, camera=replace(view.camera, translation=factor * (view.camera.translation + shift)))
            for view in whole.views
        ]
        return replace(whole, views=moved)

    for factor in (1e-7, 1.0, 1e7):
        records = [scene_record.record_of(scaled(factor, shift), 0) for shift in (0.0, 0.0, 1e-3)]
        assert scene_record.differences(records[0], records[1]) == []
        assert scene_record.differences(records[0], records[2]) != []


def test_a_scene_elsewhere_cannot_be_accepted(scene: Path, tmp_path: Path) -> None:
    known = load_scene(scene)
    run = Run.create(tmp_path / "run", TrainConfig())
    scene_record.write(run, known)
    far = load_scene(write_scene(tmp_path / "far"))
    far.origin = np.array([1024.0, 0, 0])
    refuses("has another origin in the world", scene_record.check, run, far, tmp_path, 0, accept=True)


DISPLAY = (
    *("--json", "--view", "--port 9", "--host ::1", "--paths p", "--device cpu", "--max-device-mem 1GiB"),
    *("--accept-changes", "--no-report"),
)


@pytest.mark.parametrize("given", quick(DISPLAY, "--json", "--view", "--no-report"))
def test_what_is_given_beside_resume(given: str, tmp_path: Path) -> None:
    """Each is what it would be without --resume, and the run's settings hold."""
    Run.create(tmp_path, replace(FEW, report=True))
    verb = parse(["train", "-o", str(tmp_path), "--resume", *given.split()])
    fresh = parse(["train", "-o", str(tmp_path), *given.split()])
    assert isinstance(verb, TrainVerb)
    assert isinstance(fresh, TrainVerb)
    assert replace(verb, resume=False, config=fresh.config) == fresh
    assert verb.config == replace(FEW, report="--no-report" not in given)


def test_all_display_options_beside_resume(tmp_path: Path) -> None:
    Run.create(tmp_path, FEW)
    verb = parse(["train", "-o", str(tmp_path), "--resume", *" ".join(DISPLAY).split()])
    assert isinstance(verb, TrainVerb)
    assert (verb.json, verb.view, verb.page.port, verb.accept_changes, verb.resume) == (True, True, 9, True, True)


@pytest.fixture
def foreign(run: Path, own: Path, tmp_path: Path) -> Path:
    """The run with the checkpoint of a run of another scene in it, of the same settings."""
    brighten(own / "images" / "03.png")
    assert command_train(own, tmp_path / "foreign", FEW) == 0
    shutil.copy(tmp_path / "foreign" / "checkpoints" / "step-0000003.npz", run / "checkpoints")
    return run


def test_a_checkpoint_of_another_scene_is_refused(foreign: Path, scene: Path, capsys: Capture) -> None:
    line = refusal(foreign, scene, capsys)
    named = (
        f"{foreign / 'checkpoints' / 'step-0000003.npz'}: is from a training on another scene than that of {foreign}"
    )
    said = f"{named}, expected a checkpoint of this run; remove it, or go on from it with --accept-changes"
    assert said in line
    with pytest.raises(InputError, match="is from a training on another scene"):
        train(load_scene(scene), replace(FEW, iterations=4), run=Run.open(foreign), resume=True)
    assert resume(foreign, scene, "--accept-changes") == 0
    assert resume(foreign, scene, "--iterations", "5") == 0, "from now on it is of this run"


def test_a_checkpoint_without_a_scene_is_taken(run: Path, scene: Path) -> None:
    """As earlier versions have written it."""
    path = run / "checkpoints" / "step-0000003.npz"
    with np.load(path) as archive:
        arrays = dict(archive)
    record = json.loads(arrays["state.json"].tobytes())
    assert len(record["state"].pop("scene")) == 32
    arrays["state.json"] = np.frombuffer(json.dumps(record).encode(), np.uint8)
    np.savez(path, **arrays)
    assert resume(run, scene) == 0


def test_a_checkpoint_outlives_changes_that_are_accepted(run: Path, own: Path) -> None:
    """A run that is ended before its next checkpoint."""
    own_scene = load_scene(own)
    brighten(own / "images" / "03.png")
    for resolution in (0, 40):
        changed = load_scene(own, resolution=resolution)
        opened = Run.open(run)
        opened.config = replace(opened.config, resolution=resolution)
        scene_record.write(opened, changed)
        assert not scene_record.check(opened, changed, own, resolution)
    known = scene_record.known_digests(scene_record.read(Run.open(run)))
    assert known >= {scene_record.digest_of(scene_record.record_of(own_scene, 0))}


def test_a_lens_that_is_no_pinhole_is_recorded(scene: Path) -> None:
    whole = load_scene(scene)
    plain = scene_record.record_of(whole, 0)
    bent = replace(whole.views[0], camera=replace(whole.views[0].camera, projection="fisheye", radial=(0.1, 0, 0, 0)))
    whole.views[0] = bent
    one = scene_record.record_of(whole, 0)
    whole.views[0] = replace(bent, camera=replace(bent.camera, radial=(0.1, 0.01, 0, 0)))
    other = scene_record.record_of(whole, 0)
    assert not any("radial" in view for view in plain["views"].values())
    assert one["views"][bent.name]["projection"] == "fisheye"
    assert one["views"][bent.name]["radial"] == [0.1, 0.0, 0.0, 0.0]
    assert scene_record.differences(one, one) == []
    assert scene_record.differences(one, other) == [f"1 view with another camera ({bent.name})"]
    assert scene_record.differences(one, plain) == [f"1 view with another camera ({bent.name})"]


@pytest.mark.parametrize("offset", [np.zeros(3), survey_files.UTM_OFFSET])
def test_cameras_that_moved_are_told_wherever_the_scene_lies(tmp_path: Path, offset: Float64) -> None:
    """A camera that moved by a thousandth of the scene's size, also far from the origin. Rounding does not count."""
    scene = load_scene(ring.write_colmap(tmp_path / "scene", posed=survey_files.at(offset)))
    record, other = scene_record.record_of(scene, 0), scene_record.record_of(scene, 0)
    view = scene.views[3]
    for metres, told in ((1e-7, []), (0.004, [f"1 view with another camera ({view.name})"])):
        moved = -view.camera.rotation @ (view.camera.position + np.array([metres, 0, 0]))
        other["views"][view.name]["pose"][9:] = moved.tolist()
        assert scene_record.differences(record, other) == told


def test_cameras_in_one_place_differ_by_their_coordinates(tmp_path: Path) -> None:
    posed = [ring.moved(pose, np.array([1.0, 2.0, 3.0])) for pose in ring.poses()]
    scene = load_scene(ring.write_colmap(tmp_path / "scene", posed=posed))
    record, other = scene_record.record_of(scene, 0), scene_record.record_of(scene, 0)
    other["views"][scene.views[0].name]["pose"][9] += 1e-7
    assert scene_record.differences(record, other) == []
