# SPDX-License-Identifier: Apache-2.0
"""Bad input: one line, the file's name, exit 2, and nothing is written."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import Capture, command, one_error, rejected, train
from tiny import CONFIG, HEIGHT, VIEWS, WIDTH, write_scene

from clsplat.cli.main import main


@pytest.mark.smoke
@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("", "Expected one of"),
        ("trian", "trian"),
        ("train S", "--output"),
        ("train S -o R --iterations many", "many"),
        ("train S -o R --eval-at 1,x", "'1,x' is not a list of steps, expected numbers such as 500,1000,2000"),
        ("train S -o R --background green", "green"),
        ("train S -o R --nosuch 3", "--nosuch"),
        ("render M -o R", "--cameras"),
    ],
)
def test_wrong_calls_are_one_line(line: str, message: str, capsys: Capture) -> None:
    assert message in rejected(capsys, line.split())


def test_no_such_scene_for_real(tmp_path: Path) -> None:
    done = command("train", str(tmp_path / "none"), "-o", str(tmp_path / "run"))
    assert done.returncode == 2
    assert str(tmp_path / "none") in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "run").exists()


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


def pictures_are_missing(scene: Path) -> str:
    """More than a tenth of them."""
    for name in ("03.png", "04.png"):
        (scene / "images" / name).unlink()
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
    *(no_such_folder, nothing_in_it, no_pictures, pictures_are_missing, truncated_images),
    *(corrupt_images, unknown_camera_model, unknown_camera_number, a_picture_is_cut),
    *(a_picture_is_text, without_frames, without_intrinsics, without_a_pose),
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


def all_nan(head: bytes, data: bytes) -> tuple[bytes, str]:
    return head + np.full(
        len(data) // 4, np.nan, "<f4"
    ).tobytes(), "the first is a position of Gaussian 0; expected at least one with finite values"


def no_gaussians(head: bytes, data: bytes) -> tuple[bytes, str]:
    words = head.split(b"element vertex ")
    return words[0] + b"element vertex 0" + words[1][words[1].index(b"\n") :], "0 Gaussians"


def cut_short(head: bytes, data: bytes) -> tuple[bytes, str]:
    return head + data[:-100], "truncated"


def not_a_ply(head: bytes, data: bytes) -> tuple[bytes, str]:
    return b"hello", "not a PLY"


BAD_MODELS = (no_opacity, all_nan, no_gaussians, cut_short, not_a_ply)


@pytest.mark.parametrize("spoil", BAD_MODELS, ids=lambda spoil: spoil.__name__)
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


@pytest.mark.smoke
@pytest.mark.parametrize("verb", ["train", "eval", "render"])
def test_an_unknown_device(verb: str, scene: Path, trained: Path, tmp_path: Path, capfd: Capture) -> None:
    arguments = {
        "train": [str(scene), "-o", str(tmp_path / "run")],
        "eval": [str(trained / "model.ply"), "--scene", str(scene)],
        "render": [str(trained), "--cameras", str(scene / "sparse" / "0"), "-o", str(tmp_path / "{name}.png")],
    }[verb]
    assert main([verb, *arguments, "--device", "abacus"]) == 2
    line = one_error(capfd)
    assert "--device abacus: no such device, expected cpu, gpu, a part of a name, or an index of these: 0: " in line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--device", "0,0"], "--device 0,0: has 0 twice, expected different devices, or parts of them"),
        (["--device", "0/0,0"], "--device 0/0,0: has 0 twice"),
        (["--device", "0,abacus"], "--device abacus: no such device"),
        (["--device", "0/70000"], "cannot be divided into 70001 equal parts"),
        (["--device", "0/0,0/1", "--batch", "3"], "--batch 3: expected a multiple of 2, the number of devices"),
        (["--device", "0/0,0/1", "--batch", "1"], "--batch 1: expected a multiple of 2"),
        (["--batch", "0"], "--batch 0: expected at least 1"),
    ],
)
def test_several_devices(words: list[str], line: str, scene: Path, tmp_path: Path, capfd: Capture) -> None:
    assert main(["train", str(scene), "-o", str(tmp_path / "run"), *words]) == 2
    assert line in one_error(capfd)
    assert not list(tmp_path.iterdir())


def test_one_device_where_one_is_expected(scene: Path, trained: Path, capfd: Capture) -> None:
    assert main(["eval", str(trained / "model.ply"), "--scene", str(scene), "--device", "0,1"]) == 2
    assert "--device 0,1: expected one device here; only train and render take several" in one_error(capfd)


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
    assert "is already at step 40" in capfd.readouterr().err
