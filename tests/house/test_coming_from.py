# SPDX-License-Identifier: Apache-2.0
"""docs/coming-from.md: its commands run one after the other, on files like those that it names, and its code runs."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from calls import Capture, printed
from compare import assert_close
from demo_photographs import photographs
from pictures import write_pixels
from test_docs import ROOT, code_of
from tiny import FOCAL, HEIGHT, WIDTH, cameras

from clsplat.gaussians import Gaussians
from clsplat.scenes.loading import load_scene

PAGE = ROOT / "docs/coming-from.md"
COMMANDS = list(dict.fromkeys(line for line in code_of(PAGE) if line.startswith("clsplat ")))
SMALLER = {"train": ["--iterations", "3", "--resolution", "64"], "capture": ["--iterations", "3"]}
"""Flags that are added to each command of a verb, so that it takes seconds."""
FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def poses() -> list[list[list[float]]]:
    """World from camera of the tiny scene's cameras, in OpenGL's axes, by which nerfstudio's files give them."""
    found = []
    for camera in cameras():
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = camera.rotation, camera.translation
        found.append((np.linalg.inv(pose) @ FROM_OPENGL).tolist())
    return found


@pytest.fixture
def working_folder(scene: Path, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with what the commands read, except photographs: a COLMAP project, files of nerfstudio and Postshot."""
    shutil.copytree(scene, tmp_path / "colmap-project")
    lenses = tmp_path / "colmap-project/sparse/0/cameras.txt"  # a lens with distortion, as stmaps needs one
    lenses.write_text(re.sub("PINHOLE (.*)", r"OPENCV \1 0.01 0 0 0", lenses.read_text()))
    shutil.copytree(scene / "images", tmp_path / "nerfstudio-data" / "images")
    names = sorted(path.name for path in (scene / "images").iterdir())
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": pose} for name, pose in zip(names, poses(), strict=True)
    ]
    lens = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    (tmp_path / "nerfstudio-data/transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    path = [{"camera_to_world": np.ravel(pose).tolist(), "fov": 40} for pose in poses()[:2]]
    size = {"camera_type": "perspective", "render_width": WIDTH, "render_height": HEIGHT, "camera_path": path}
    (tmp_path / "camera_path.json").write_text(json.dumps(size))
    shutil.copyfile(trained / "model.ply", tmp_path / "nerfstudio.ply")
    line, with_comment = b"element vertex", b"comment antialiased 1\nelement vertex"
    (tmp_path / "postshot.ply").write_bytes((trained / "model.ply").read_bytes().replace(line, with_comment, 1))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_every_command_runs(working_folder: Path, capsys: Capture) -> None:
    for index, pixels in enumerate(photographs(range(12), 240, 180)[0]):
        write_pixels(working_folder / f"photos/{index:02}.png", pixels)
    shown = {}
    # sfm first: gsplat's section, the first one, takes a scene for granted
    for command in sorted(COMMANDS, key=lambda command: " sfm " not in command):
        verb, *words = shlex.split(command)[1:]
        shown[command] = printed(capsys, [verb, *words, *SMALLER.get(verb, [])]).out
    assert len(shown) == len(COMMANDS) > 14
    runs = {path.parent.name for path in working_folder.glob("*/model.ply")}
    assert runs == {"run", "run-mcmc", "run-nerfstudio", "run-random", "run-colmap"}
    assert (working_folder / "shot/run/model.ply").is_file() and (working_folder / "shot/report.html").is_file()
    assert [len(list(working_folder.glob(f"{name}/*.png"))) for name in ("frames", "views")] == [2, 10]
    assert re.search("antialiased +yes", shown["clsplat info postshot.ply"])
    assert 0 < len(Gaussians.load("part.ply")) < len(Gaussians.load("postshot.ply"))
    assert (working_folder / "scene/sparse/0/cameras.bin").is_file()


def test_poses_of_both_kinds_of_file_are_read_alike(working_folder: Path) -> None:
    ours, theirs = (load_scene(working_folder / name) for name in ("colmap-project", "nerfstudio-data"))
    for one, other in zip(ours.train_views, theirs.train_views, strict=True):
        assert one.name == Path(other.name).name
        # the text has every digit of float64; both ways normalise rotations, which costs some units in the last place
        assert_close(other.camera.rotation, one.camera.rotation, absolute=1e-6)
        assert_close(other.camera.translation, one.camera.translation, absolute=1e-6)


@pytest.mark.needs("torch")
def test_the_block_of_gsplats_call_runs(trained: Path) -> None:
    import torch

    model = Gaussians.load(trained / "model.ply")
    camera = cameras()[0]
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[:3, :3], viewmat[:3, 3] = camera.rotation, camera.translation
    values = {
        "means": model.means,
        "quats": model.quaternions,
        "scales": np.exp(model.log_scales),
        "opacities": 1 / (1 + np.exp(-model.opacity_logits)),
        "colors": 0.5 + 0.28209479 * model.sh[:, 0],
        "viewmats": viewmat[None],
        "Ks": np.float32([[[FOCAL, 0, 320], [0, FOCAL, 240], [0, 0, 1]]]),
    }
    names = {name: torch.from_numpy(np.ascontiguousarray(value, np.float32)) for name, value in values.items()}
    (block,) = re.findall(r"^```python\n(.*?)^```", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    exec(block, names)
    assert names["images"].shape == (1, 480, 640, 3) and names["alphas"].shape == (1, 480, 640, 1)
    assert float(names["alphas"].max()) > 0.1
