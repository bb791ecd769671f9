# SPDX-License-Identifier: Apache-2.0
"""The command line on the real pipeline: train, eval, render, and being stopped in the middle in every way."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from compare import assert_close
from tiny import CONFIG, HEIGHT, VIEWS, WIDTH, short, write_scene

import clsplat
from clsplat.cli import main
from clsplat.config import TrainConfig
from clsplat.runs import Run

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("cli") / "scene")


def flags(config: object, prefix: str = "--") -> list[str]:
    """Every setting as a user would give it."""
    words: list[str] = []
    for field in fields(config):  # type: ignore[arg-type]
        value, name = getattr(config, field.name), prefix + field.name.replace("_", "-")
        if is_dataclass(value):
            words += flags(value, f"{name}.")
        elif isinstance(value, tuple):
            words += [name, ",".join(map(str, value))]
        elif not isinstance(value, bool):
            words += [name, str(value)]
    return words


def train(scene: Path, run: Path, config: TrainConfig, *more: str) -> int:
    return main(["train", str(scene), "-o", str(run), *flags(config), *more])


@pytest.fixture(scope="module")
def trained(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of CONFIG; not to be changed."""
    run = tmp_path_factory.mktemp("trained") / "run"
    assert train(scene, run, CONFIG) == 0
    return run


def one_error(capfd: Capture) -> str:
    """The last words: nothing on standard output, one line of error, no traceback, nothing from any library."""
    captured = capfd.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("clsplat: error: "), captured.err
    assert captured.err.count("\n") == 1, captured.err
    return captured.err


# From photographs to pictures


def test_train_leaves_a_run(trained: Path, scene: Path) -> None:
    names = {str(path.relative_to(trained)) for path in trained.rglob("*") if path.is_file()}
    expected = {"config.toml", "model.ply", "metrics.jsonl", "eval.json", "test/00.png", "test/08.png"}
    assert names == {*expected, "checkpoints/step-0000040.npz"}
    run = Run.open(trained)
    assert run.config == CONFIG
    assert run.scene == scene
    assert [record["step"] for record in run.read_metrics()] == [10, 20, 30, 40]
    model = clsplat.Gaussians.load(run.model_path)
    assert model.sh_degree == 2
    assert run.model_record()["gaussians"] == len(model)


def test_eval_finds_what_training_found(trained: Path, scene: Path, capfd: Capture) -> None:
    stored = json.loads((trained / "eval.json").read_text())
    assert main(["eval", str(trained / "model.ply"), "--scene", str(scene), "--json"]) == 0
    result = json.loads(capfd.readouterr().out)
    assert [view["name"] for view in result["views"]] == ["00.png", "08.png"]
    for key in ("views", "mean", "gaussians"):
        assert result[key] == stored[key]
    assert main(["eval", str(trained), "--test-every", "2"]) == 0
    out = capfd.readouterr().out
    assert "5 held-out views" in out
    (trained / "eval.json").write_text(json.dumps(stored))


@pytest.mark.parametrize("extension", ["exr", "png"])
@pytest.mark.parametrize("alpha", [False, True])
def test_render_writes_what_clsplat_render_gives(
    extension: str, alpha: bool, trained: Path, scene: Path, tmp_path: Path, capfd: Capture
) -> None:
    pattern = str(tmp_path / "frames" / f"{{name}}.{extension}")
    how = ["--alpha"] if alpha else ["--background", "0.2,0.4,0.6"]
    line = ["render", str(trained), "--cameras", str(scene / "sparse" / "0"), "-o", pattern, "--json", *how]
    assert main(line) == 0
    records = json.loads(capfd.readouterr().out)
    assert [record["name"] for record in records] == [f"{index:02d}.png" for index in range(VIEWS)]
    model, views = clsplat.Gaussians.load(trained / "model.ply"), clsplat.load_scene(scene).views
    for view, record in list(zip(views, records, strict=True))[::4]:
        result = clsplat.render(model, view.camera, (0, 0, 0) if alpha else (0.2, 0.4, 0.6))
        file = oiio.ImageInput.open(record["path"])
        spec = file.spec()
        assert (spec.width, spec.height, spec.nchannels) == (WIDTH, HEIGHT, 4 if alpha else 3)
        assert list(spec.channelnames) == ["R", "G", "B", "A"][: spec.nchannels]
        wanted = result.image
        if alpha:  # OpenImageIO gives premultiplied pixels for either format
            wanted = np.concatenate([wanted, result.alpha[:, :, None]], axis=2)
        pixels = np.asarray(file.read_image(oiio.FLOAT))
        file.close()
        if extension == "exr":
            assert str(spec.format) == "float"
            np.testing.assert_array_equal(pixels, wanted)
        else:
            assert str(spec.format) == "uint8"
            # half a level; straight in the file: a half of colour and of alpha each, and what the reader rounds
            assert_close(pixels, np.clip(wanted, 0, 1), absolute=(1.51 if alpha else 0.501) / 255)


def test_a_run_is_not_trained_over(trained: Path, scene: Path, capfd: Capture) -> None:
    before = {path: path.read_bytes() for path in trained.rglob("*") if path.is_file()}
    assert train(scene, trained, CONFIG) == 2
    assert f"{trained}: is already a run, use --resume" in one_error(capfd)
    assert {path: path.read_bytes() for path in trained.rglob("*") if path.is_file()} == before


def test_overwriting_starts_again(trained: Path, scene: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert train(scene, run, short(iterations=3, seed=5)) == 0
    assert train(scene, run, CONFIG, "--overwrite") == 0
    assert (run / "model.ply").read_bytes() == (trained / "model.ply").read_bytes()


def test_more_iterations_later(trained: Path, scene: Path, tmp_path: Path, capfd: Capture) -> None:
    run = tmp_path / "run"
    assert train(scene, run, short(iterations=17)) == 0
    first = json.loads((run / "eval.json").read_text())
    assert first["step"] == 17
    assert main(["train", "-o", str(run), "--resume", "--iterations", "40"]) == 0
    assert (run / "model.ply").read_bytes() == (trained / "model.ply").read_bytes()
    assert json.loads((run / "eval.json").read_text())["step"] == 40
    # again, with nothing left to do: the same model
    assert main(["train", "-o", str(run), "--resume"]) == 0
    assert (run / "model.ply").read_bytes() == (trained / "model.ply").read_bytes()


def test_a_scene_without_points_and_with_alpha(tmp_path: Path, capfd: Capture) -> None:
    scene = write_scene(tmp_path / "scene", alpha=True, points=False)
    config = short(iterations=5, random_points=50, background="white")
    assert train(scene, tmp_path / "run", config) == 0
    captured = capfd.readouterr()
    assert "has no points, training starts from random ones" in captured.err
    assert "50 Gaussians" in captured.out


def test_a_scene_of_one_point(tmp_path: Path, capfd: Capture) -> None:
    scene = write_scene(tmp_path / "scene")
    points = scene / "sparse" / "0" / "points3D.txt"
    points.write_text(points.read_text().splitlines()[0] + "\n")
    assert train(scene, tmp_path / "run", short(iterations=2)) == 0
    warned = [line for line in capfd.readouterr().err.splitlines() if "warning" in line]
    assert warned == [
        f"clsplat: warning: {scene}: has a single point, training starts from one Gaussian of next to no size"
    ]


# Stopped in the middle

LONG = short(iterations=600, checkpoint_every=100)
"""A few seconds: long enough to be stopped in."""


@pytest.fixture(scope="module")
def long_model(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    run = tmp_path_factory.mktemp("long") / "run"
    assert train(scene, run, LONG) == 0
    return (run / "model.ply").read_bytes()


def start(scene: Path, run: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "clsplat", "train", str(scene), "-o", str(run), *flags(LONG)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def wait_until(ready: Callable[[], bool], process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 120  # a build of every kernel on a busy machine
    while not ready():
        assert process.poll() is None, f"it ended by itself: {process.stderr.read() if process.stderr else ''}"
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_ctrl_c_and_resume_give_the_same_model(scene: Path, tmp_path: Path, long_model: bytes, capfd: Capture) -> None:
    run = tmp_path / "run"
    process = start(scene, run)
    wait_until(lambda: (run / "metrics.jsonl").exists() and len(Run.open(run).read_metrics()) > 2, process)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in err
    ((step, _),) = Run.open(run).checkpoints()[-1:]
    assert 30 <= step < LONG.iterations
    message = f"clsplat: interrupted at step {step}; go on with: clsplat train -o {run} --resume"
    assert err.splitlines()[-1] == message
    assert not (run / "model.ply").exists()
    assert main(message.rpartition("clsplat ")[2].split()) == 0
    assert (run / "model.ply").read_bytes() == long_model
    steps = [record["step"] for record in Run.open(run).read_metrics()]
    assert steps == list(range(10, LONG.iterations + 1, 10))


def test_kill_and_resume_give_the_same_model(scene: Path, tmp_path: Path, long_model: bytes, capfd: Capture) -> None:
    run = tmp_path / "run"
    process = start(scene, run)
    # the checkpoint of step 200 is there, and metrics beyond it, which resuming has to take back
    wait_until(lambda: (run / "metrics.jsonl").exists() and len(Run.open(run).read_metrics()) >= 23, process)
    process.kill()
    process.communicate(timeout=60)
    assert process.returncode == -signal.SIGKILL
    assert not (run / "model.ply").exists()
    assert main(["train", "-o", str(run), "--resume"]) == 0
    assert (run / "model.ply").read_bytes() == long_model
    steps = [record["step"] for record in Run.open(run).read_metrics()]
    assert steps == list(range(10, LONG.iterations + 1, 10))


def test_ctrl_c_before_the_first_step(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Capture
) -> None:
    from clsplat import trainer

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    run = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(trainer, "upload_gaussians", interrupt)
        assert train(scene, run, CONFIG) == 130
    message = f"clsplat: interrupted before the first checkpoint; go on with: clsplat train -o {run} --resume"
    started, interrupted = capfd.readouterr().err.splitlines()
    assert started.startswith(f"{scene.name}: 8 pictures to train on, 2 held out, 40 points; on ")
    assert interrupted == message
    assert main(["train", "-o", str(run), "--resume", "--iterations", "3"]) == 0


class FailingWrites:
    """Lets a number of flushes to the disk through, then raises."""

    def __init__(self, error: BaseException, after: int) -> None:
        self.error, self.left = error, after

    def __call__(self, _descriptor: int) -> None:
        self.left -= 1
        if self.left < 0:
            raise self.error


def full() -> OSError:
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("stage", ["config.toml", "checkpoint", "model.ply", "eval.json"])
@pytest.mark.parametrize("kind", ["full disk", "Ctrl-C"])
def test_a_write_that_fails_leaves_what_was_there(
    kind: str, stage: str, scene: Path, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Capture
) -> None:
    """On the way from step 17 to 40: config, metrics cut back, checkpoint, model and evaluation are flushed in turn,
    each file and then its folder."""
    run = tmp_path / "run"
    assert train(scene, run, short(iterations=17)) == 0
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    capfd.readouterr()
    order = ["config.toml", "metrics.jsonl", "checkpoint", "model.ply", "eval.json"]
    error = full() if kind == "full disk" else KeyboardInterrupt()
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", FailingWrites(error, 2 * order.index(stage)))
        status = main(["train", "-o", str(run), "--resume", "--iterations", "40"])
    last = capfd.readouterr().err.splitlines()[-1]
    names = {"checkpoint": run / "checkpoints" / "step-0000040.npz"}
    if kind == "full disk":
        assert status == 1
        assert last == f"clsplat: error: [Errno 28] No space left on device: '{names.get(stage, run / stage)}'"
    else:
        assert status == 130
        assert "interrupted" in last
    if stage not in ("model.ply", "eval.json"):
        assert (run / "model.ply").read_bytes() == before[run / "model.ply"]
    assert (run / "eval.json").read_bytes() == before[run / "eval.json"]
    assert not [path for path in run.rglob(".*") if path.is_file()], "no half-written file stays"
    # and once there is room again
    assert main(["train", "-o", str(run), "--resume", "--iterations", "40"]) == 0
    assert (run / "model.ply").read_bytes() == (trained / "model.ply").read_bytes()


def test_a_full_disk_while_metrics_are_written_names_them(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Capture
) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full on this system")
    run = Run.create(tmp_path / "run", short(iterations=12), scene=scene)
    run.metrics_path.symlink_to("/dev/full")
    monkeypatch.setattr(Run, "truncate_metrics", lambda *_: None)  # it would put a file in the link's place
    assert main(["train", "-o", str(run.path), "--resume"]) == 1
    assert f"No space left on device: '{run.metrics_path}'" in capfd.readouterr().err.splitlines()[-1]


# Bad input: one line, the file's name, exit 2, and nothing is written


def colmap_binary(scene: Path) -> Path:
    """The scene's model as binary files instead of text; the folder."""
    import pycolmap

    folder = scene / "sparse" / "0"
    pycolmap.Reconstruction(folder).write_binary(folder)
    for path in folder.glob("*.txt"):
        path.unlink()
    return folder


def cut(path: Path, keep: float = 0.6) -> str:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])
    return str(path)


def no_such_folder(scene: Path) -> str:
    scene.rename(scene.with_name("elsewhere"))
    return f"{scene}: no such folder"


def nothing_in_it(scene: Path) -> str:
    scene.rename(scene.with_name("elsewhere"))
    scene.mkdir()
    return f"{scene}: no images found"


def no_pictures(scene: Path) -> str:
    for path in (scene / "images").iterdir():
        path.unlink()
    return f"{scene / 'images'}: no images found"


def a_picture_is_missing(scene: Path) -> str:
    (scene / "images" / "03.png").unlink()
    return str(scene / "images" / "03.png")


def truncated_images(scene: Path) -> str:
    return cut(colmap_binary(scene) / "images.bin")


def corrupt_images(scene: Path) -> str:
    path = colmap_binary(scene) / "images.bin"
    data = bytearray(path.read_bytes())
    data[:8] = b"\xff" * 8  # so many images
    path.write_bytes(data)
    return str(path)


def unknown_camera_model(scene: Path) -> str:
    path = scene / "sparse" / "0" / "cameras.txt"
    path.write_text(path.read_text().replace("PINHOLE", "KALEIDOSCOPE"))
    return str(path)


def unknown_camera_number(scene: Path) -> str:
    path = colmap_binary(scene) / "cameras.bin"
    data = bytearray(path.read_bytes())
    data[12:16] = (99).to_bytes(4, "little")
    path.write_bytes(data)
    return str(path)


def a_picture_is_cut(scene: Path) -> str:
    return cut(scene / "images" / "04.png")


def a_picture_is_text(scene: Path) -> str:
    path = scene / "images" / "04.png"
    path.write_text("not a picture")
    return str(path)


def without_frames(scene: Path) -> str:
    return transforms(scene, lambda keys: keys.pop("frames"))


def without_intrinsics(scene: Path) -> str:
    return transforms(scene, lambda keys: keys.pop("fl_x"))


def without_a_pose(scene: Path) -> str:
    return transforms(scene, lambda keys: keys["frames"][1].pop("transform_matrix"))


def transforms(scene: Path, spoil: Callable[[dict[str, Any]], object]) -> str:
    shutil.rmtree(scene / "sparse")
    frames = [{"file_path": f"images/{i:02d}.png", "transform_matrix": np.eye(4).tolist()} for i in range(VIEWS)]
    keys = {"fl_x": 50, "w": WIDTH, "h": HEIGHT, "frames": frames}
    path = scene / "transforms.json"
    spoil(keys)
    path.write_text(json.dumps(keys))
    return str(path)


BAD_SCENES = (
    no_such_folder,
    nothing_in_it,
    no_pictures,
    a_picture_is_missing,
    truncated_images,
    corrupt_images,
    unknown_camera_model,
    unknown_camera_number,
    a_picture_is_cut,
    a_picture_is_text,
    without_frames,
    without_intrinsics,
    without_a_pose,
)


@pytest.mark.parametrize("spoil", BAD_SCENES, ids=lambda spoil: spoil.__name__)
@pytest.mark.parametrize("verb", ["train", "eval"])
def test_bad_scenes(verb: str, spoil: Callable[[Path], str], trained: Path, tmp_path: Path, capfd: Capture) -> None:
    scene = write_scene(tmp_path / "scene")
    named = spoil(scene)
    before = {path: path.stat().st_mtime_ns for path in scene.rglob("*")} if scene.exists() else {}
    capfd.readouterr()
    if verb == "train":
        assert main(["train", str(scene), "-o", str(tmp_path / "run"), "--iterations", "2"]) == 2
        assert not (tmp_path / "run").exists()
    else:
        assert main(["eval", str(trained / "model.ply"), "--scene", str(scene)]) == 2
    assert named in one_error(capfd)
    assert ({path: path.stat().st_mtime_ns for path in scene.rglob("*")} if scene.exists() else {}) == before


def no_opacity(head: bytes, data: bytes) -> tuple[bytes, str]:
    return head.replace(b"float opacity", b"float opaque") + data, "property opacity"


def nan_position(head: bytes, data: bytes) -> tuple[bytes, str]:
    return head + np.float32(np.nan).tobytes() + data[4:], "have a position"


def no_gaussians(head: bytes, data: bytes) -> tuple[bytes, str]:
    words = head.split(b"element vertex ")
    return words[0] + b"element vertex 0" + words[1][words[1].index(b"\n") :], "0 Gaussians"


def cut_short(head: bytes, data: bytes) -> tuple[bytes, str]:
    return head + data[:-100], "truncated"


@pytest.mark.parametrize("spoil", [no_opacity, nan_position, no_gaussians, cut_short], ids=lambda spoil: spoil.__name__)
@pytest.mark.parametrize("verb", ["render", "eval"])
def test_bad_models(
    verb: str,
    spoil: Callable[[bytes, bytes], tuple[bytes, str]],
    scene: Path,
    trained: Path,
    tmp_path: Path,
    capfd: Capture,
) -> None:
    head, mark, data = (trained / "model.ply").read_bytes().partition(b"end_header\n")
    content, trouble = spoil(head + mark, data)
    model = tmp_path / "bad.ply"
    model.write_bytes(content)
    out = tmp_path / "out" / "{name}.png"
    rest = ["--scene", str(scene)] if verb == "eval" else ["--cameras", str(scene / "sparse" / "0"), "-o", str(out)]
    assert main([verb, str(model), *rest]) == 2
    line = one_error(capfd)
    assert str(model) in line
    assert trouble in line
    assert not out.parent.exists()


def test_bad_cameras_for_render(trained: Path, tmp_path: Path, capfd: Capture) -> None:
    scene = write_scene(tmp_path / "scene")
    named = truncated_images(scene)
    out = tmp_path / "out" / "{name}.png"
    assert main(["render", str(trained), "--cameras", str(scene / "sparse" / "0"), "-o", str(out)]) == 2
    assert named in one_error(capfd)
    assert not out.parent.exists()


@pytest.mark.parametrize("verb", ["train", "eval", "render"])
def test_an_unknown_device(verb: str, scene: Path, trained: Path, tmp_path: Path, capfd: Capture) -> None:
    arguments = {
        "train": [str(scene), "-o", str(tmp_path / "run")],
        "eval": [str(trained / "model.ply"), "--scene", str(scene)],
        "render": [str(trained), "--cameras", str(scene / "sparse" / "0"), "-o", str(tmp_path / "{name}.png")],
    }[verb]
    assert main([verb, *arguments, "--device", "abacus"]) == 2
    line = one_error(capfd)
    assert "--device abacus: no such device; there are 0: " in line
    assert not list(tmp_path.iterdir())


def test_overwriting_with_what_cannot_be_trained_keeps_the_run(scene: Path, tmp_path: Path, capfd: Capture) -> None:
    run = tmp_path / "run"
    assert train(scene, run, CONFIG) == 0
    model = (run / "model.ply").read_bytes()
    for wrong in (["--test-every", "1"], ["--resolution", "8"]):
        capfd.readouterr()
        assert main(["train", str(scene), "-o", str(run), "--overwrite", "--iterations", "3", *wrong]) == 2
        assert len(capfd.readouterr().err.splitlines()) == 1
        assert (run / "model.ply").read_bytes() == model
    assert main(["train", "-o", str(run), "--resume", "--iterations", "3"]) == 2
    assert "is at step 40 already" in capfd.readouterr().err
