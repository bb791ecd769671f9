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
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from calls import Capture, flags, one_error, raising, train
from compare import assert_close
from pages import parse
from quick import quick
from systems import posix
from tiny import CONFIG, HEIGHT, VIEWS, WIDTH, short, write_scene

import clsplat
from clsplat.cli.main import main
from clsplat.images.colour import srgb_to_linear
from clsplat.images.reading import read_image
from clsplat.images.writing import write_image
from clsplat.report.thumbnails import data_uri
from clsplat.runs.run import Run

# From photographs to pictures


@pytest.mark.smoke
def test_train_leaves_a_run(trained: Path, scene: Path) -> None:
    names = {str(path.relative_to(trained)) for path in trained.rglob("*") if path.is_file()}
    expected = {
        *("config.toml", "scene.json", "model.ply", "metrics.jsonl", "eval.json", "report.html"),
        *("test/00.png", "test/08.png", "depth/00.png", "depth/08.png", "checkpoints/step-0000040.npz"),
    }
    assert names == expected
    run = Run.open(trained)
    assert run.config == CONFIG
    assert run.scene == scene
    assert [record["step"] for record in run.read_metrics()] == [10, 20, 30, 40]
    model = clsplat.Gaussians.load(run.model_path)
    assert model.sh_degree == 2
    assert run.model_record()["gaussians"] == len(model)


@pytest.mark.smoke
def test_eval_finds_what_training_found(trained: Path, scene: Path, capfd: Capture) -> None:
    stored = json.loads((trained / "eval.json").read_text())
    assert main(["eval", str(trained / "model.ply"), "--scene", str(scene), "--json"]) == 0
    result = json.loads(capfd.readouterr().out)
    assert [view["name"] for view in result["views"]] == ["00.png", "08.png"]
    for key in ("views", "mean", "gaussians"):
        assert result[key] == stored[key]
    assert main(["eval", str(trained), "--test-every", "2", "--corrected"]) == 0
    out = capfd.readouterr().out
    assert "5 held-out views" in out
    means = json.loads((trained / "eval.json").read_text())["mean"]
    assert means["psnr_corrected"] > means["psnr"]
    assert f"colour-corrected {means['psnr_corrected']:.2f} dB" in out
    (trained / "eval.json").write_text(json.dumps(stored))


def test_pictures_of_a_linear_model_are_srgb(scene: Path, tmp_path: Path, capfd: Capture) -> None:
    """As everybody who opens a PNG takes them: what training and evaluation leave, and the report's photographs."""
    linear, run = Path(shutil.copytree(scene, tmp_path / "linear")), tmp_path / "run"
    for photo in (linear / "images").iterdir():
        write_image(photo.with_suffix(".exr"), srgb_to_linear(read_image(photo)))
        photo.unlink()
    listed = linear / "sparse" / "0" / "images.txt"
    listed.write_text(listed.read_text().replace(".png", ".exr"))
    assert train(linear, run, short(iterations=4, eval_at=(), stages_every=0)) == 0
    left = (run / "test" / "00.png").read_bytes()
    frames = ["render", str(run), "--cameras", str(linear), "-o", str(tmp_path / "{name}.png"), "--frames", "1"]
    assert main([*frames, "--colorspace", "sRGB"]) == 0
    expected = read_image(tmp_path / "00.png")
    np.testing.assert_array_equal(read_image(run / "test" / "00.png"), expected)
    assert np.abs(srgb_to_linear(expected) - expected).max() > 0.1, "the curve is seen"
    (run / "test" / "00.png").unlink()
    assert main(["eval", str(run)]) == 0
    assert (run / "test" / "00.png").read_bytes() == left
    photo = parse((run / "report.html").read_text("utf-8")).all("figure", class_="view")[0].all("img")[0]
    assert photo.attributes["src"] == data_uri(read_image(scene / "images" / "00.png"))


@pytest.mark.smoke
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


@pytest.mark.smoke
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
    assert "has no points; training starts from random points" in captured.err
    assert "50 Gaussians" in captured.out


def test_a_scene_of_one_point(tmp_path: Path, capfd: Capture) -> None:
    scene = write_scene(tmp_path / "scene")
    points = scene / "sparse" / "0" / "points3D.txt"
    points.write_text(points.read_text().splitlines()[0] + "\n")
    assert train(scene, tmp_path / "run", short(iterations=2, warmup=())) == 0
    warned = [line for line in capfd.readouterr().err.splitlines() if "warning" in line]
    said = "has a single point, expected several: training starts with one Gaussian of almost no size"
    assert warned == [f"clsplat: warning: {scene}: {said}"]


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


@pytest.mark.slow
@posix
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


@pytest.mark.slow
def test_kill_and_resume_give_the_same_model(scene: Path, tmp_path: Path, long_model: bytes, capfd: Capture) -> None:
    run = tmp_path / "run"
    process = start(scene, run)
    # the checkpoint of step 200 is there, and metrics beyond it, which resuming has to take back
    wait_until(lambda: (run / "metrics.jsonl").exists() and len(Run.open(run).read_metrics()) >= 23, process)
    process.kill()
    process.communicate(timeout=60)
    assert process.returncode == (-signal.SIGKILL if os.name == "posix" else 1)
    assert not (run / "model.ply").exists()
    assert main(["train", "-o", str(run), "--resume"]) == 0
    assert (run / "model.ply").read_bytes() == long_model
    steps = [record["step"] for record in Run.open(run).read_metrics()]
    assert steps == list(range(10, LONG.iterations + 1, 10))


def test_ctrl_c_before_the_first_step(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Capture
) -> None:
    from clsplat.training import trained_model

    run = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(trained_model, "upload_gaussians", raising(KeyboardInterrupt()))
        assert train(scene, run, CONFIG) == 130
    message = f"clsplat: interrupted before the first checkpoint; go on with: clsplat train -o {run} --resume"
    looked, started, *_, interrupted = capfd.readouterr().err.splitlines()
    assert looked.startswith("inspected 10 photographs: ")
    assert started.startswith(f"{scene.name}: 8 training pictures, 2 held out, 40 points; on ")
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


@pytest.mark.parametrize(
    "stage", quick(["config.toml", "checkpoint", "model.ply", "eval.json"], "checkpoint", "model.ply")
)
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
        said = f"clsplat: error: {names.get(stage, run / stage)}: cannot be written: the disk is full: "
        assert last.startswith(said)
        assert " are needed and " in last
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
    monkeypatch.setattr(Run, "read_metrics", lambda _: [])  # /dev/full has no end
    assert main(["train", "-o", str(run.path), "--resume"]) == 1
    assert f"{run.metrics_path}: cannot be written: the disk is full: " in capfd.readouterr().err.splitlines()[-1]
