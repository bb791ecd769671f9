# SPDX-License-Identifier: Apache-2.0
"""Opacities and scales in place of logits and logs: which models are doubted, what is made of them, their numbers."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from calls import Capture, no_warnings, only, printed, warned, warnings_of
from models import random_gaussians
from splats import lopsided

from clsplat.cli.main import main
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.models import formats
from clsplat.models.codec import repair, values
from clsplat.models.formats import gltf
from clsplat.models.info import model_info

RNG = np.random.default_rng(7)
LOGS = RNG.normal(-3, 1, (3000, 3)).astype(np.float32)


def trained(highest: float) -> np.ndarray:
    """Logits as a training leaves them: most a little opaque, fewer and fewer up to the highest opacity."""
    logits = RNG.normal(-1.5, 1.2, 200_000)
    return logits[logits <= np.log(highest / (1 - highest))][:3000].astype(np.float32)


@pytest.mark.parametrize("highest", [0.6, 0.7, 0.8, 0.95, 1 - 1e-4])
@pytest.mark.parametrize("least", [0.0, 0.3, 0.49, 0.5, 0.52, 0.6, 0.65])
def test_pruned_models_are_not_doubted(highest: float, least: float) -> None:
    if least < highest:
        logits = np.concatenate([trained(highest) for _ in range(5)])
        left = logits[values.opacities(logits) >= least]
        assert repair.encoding_warnings(left, np.resize(LOGS, (len(left), 3))) == []


@pytest.mark.parametrize("start", [0.5, 0.55, 0.6, 0.7])
@pytest.mark.parametrize("moved", [0.0, 0.02, 0.1])
def test_models_that_were_started_at_an_opacity_are_not_doubted(start: float, moved: float) -> None:
    logits = (np.log(start / (1 - start)) + np.abs(RNG.normal(0, moved, 3000))).astype(np.float32)
    assert repair.encoding_warnings(logits, LOGS) == []


@pytest.mark.parametrize("highest", [0.95, 0.99, 1 - 1e-4])
@pytest.mark.parametrize("least", [0.0, 0.05, 0.3])
def test_opacities_of_trained_models_are_doubted(highest: float, least: float) -> None:
    opacity = np.r_[values.opacities(trained(highest)), highest].astype(np.float32)
    opacity = opacity[opacity >= least]
    (text,) = repair.encoding_warnings(opacity, np.resize(LOGS, (len(opacity), 3)))
    assert text.startswith("all opacities are between ")
    assert "as opacities from 0 to 1 are" in text


@pytest.mark.parametrize("white", [100, 255, 65535])
@pytest.mark.parametrize("dark", [False, True])
def test_levels_of_any_white(tmp_path: Path, white: int, dark: bool) -> None:
    """dark: nothing is more opaque than two thirds, which is over 100 of 255."""
    path, model = tmp_path / "model.ply", lopsided(400, degree=0)
    levels = np.rint(RNG.uniform(0, (0.66 if dark else 1) * white, 400))
    model.opacity_logits = levels.astype(np.float32)
    model.save(path)
    assert ("as percentages are" if white == 100 else "as levels are") in only(warnings_of(lambda: formats.load(path)))
    right = formats.load(path, activated="opacities")
    np.testing.assert_allclose(values.opacities(right.opacity_logits), levels / white, atol=1e-6)  # float32's


def test_levels_of_which_it_cannot_be_known(tmp_path: Path) -> None:
    path, model = tmp_path / "model.ply", lopsided(400, degree=0)
    model.opacity_logits = np.arange(400, dtype=np.float32) % 36
    model.save(path)
    with pytest.raises(InputError, match=r"up to 35, which may be percentages or levels .* at least 40$"):
        formats.load(path, activated="opacities")


@pytest.mark.parametrize("ending", [".ply", ".usda"])
def test_convert_tells_of_its_source_once(tmp_path: Path, ending: str, capsys: Capture) -> None:
    if ending == ".usda":
        pytest.importorskip("pxr")
    model = lopsided(400, degree=0)
    model.opacity_logits = RNG.uniform(0, 1, 400).astype(np.float32)
    model.save(tmp_path / "model.ply")
    said = printed(capsys, ["convert", tmp_path / "model.ply", tmp_path / f"other{ending}"]).err
    assert said.count("as opacities from 0 to 1 are") == 1
    model.opacity_logits = np.concatenate([trained(0.69), trained(0.69)])[:400]
    model.save(tmp_path / "model.ply")
    pruned = str(tmp_path / f"pruned{ending}")
    assert main(["convert", str(tmp_path / "model.ply"), pruned, "--prune-opacity", "0.5"]) == 0
    assert printed(capsys, ["info", pruned]).err == ""


def with_bad_rows(path: Path) -> Gaussians:
    """20 Gaussians, of which 2 and 5 are not finite."""
    model = random_gaussians(20, 0)
    model.opacity_logits = np.full(20, 0.5, np.float32)
    model.log_scales = np.full((20, 3), 0.5, np.float32)
    model.save(path)
    data = bytearray(path.read_bytes())
    row = len(data) - data.index(b"end_header\n") - len(b"end_header\n")
    start, row = len(data) - row, row // 20
    for at in (2, 5):
        data[start + at * row : start + at * row + 4] = struct.pack("<f", np.nan)
    for at, place, value in ((3, -16, 0.0), (5, -16, 0.0), (9, -32, 1.5), (12, -28, -1.0)):
        end = start + (at + 1) * row
        count = 4 if place == -16 else 1
        data[end + place : end + place + 4 * count or None] = struct.pack(f"<{count}f", *[value] * count)
    path.write_bytes(data)
    return model


def test_numbers_are_those_of_the_file(tmp_path: Path) -> None:
    """Though Gaussians before are left out; one that is left out has no rotation either, and does not count."""
    path = tmp_path / "model.ply"
    with_bad_rows(path)
    out, turned = warnings_of(lambda: formats.load(path))
    assert "2 of 20 Gaussians have a value that is not finite, the first is a position of Gaussian 2" in out
    assert "1 of 20 Gaussians has a quaternion of 0, the first is Gaussian 3; it is drawn unrotated" in turned
    for which, said in (
        ("opacities", "Gaussian 9 has an opacity of"),
        ("scales", "Gaussian 12 has a scale of -1"),
    ):
        with pytest.warns(UserWarning, match="left out"), pytest.raises(InputError, match=said):
            formats.load(path, activated=which)


def test_info_counts_quaternions_of_0(tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "model.ply"
    with_bad_rows(path)
    figures = model_info(path)
    assert (figures["not_finite"], figures["zero_quaternions"]) == (2, 1)
    said = printed(capsys, ["info", path]).out
    assert "20, 2 of them not finite and left out, 1 with a quaternion of 0, drawn unrotated" in said
    random_gaussians(20, 0).save(path)
    assert model_info(path)["zero_quaternions"] == 0
    assert "quaternion" not in printed(capsys, ["info", path]).out


@pytest.mark.parametrize("huge", [800.0, 1000.0, 3e38])
def test_info_of_scales_that_no_float_holds(tmp_path: Path, huge: float) -> None:
    path, model = tmp_path / "model.ply", random_gaussians(200, 0)
    model.log_scales[:8, 1] = huge
    model.save(path)
    with no_warnings():
        scale = model_info(path)["scale"]
    assert all(np.isfinite(value) for value in scale.values())
    assert scale["p100"] > 1e300


def generated(path: Path, generator: object, *offsets: float) -> list[np.ndarray]:
    """A .gltf by that program, a primitive for each offset of its logs, which are in place of scales."""
    document, found = {}, []
    for offset in offsets:
        model = lopsided(100, degree=0)
        gltf.write(path, model)
        document = json.loads(path.read_text())
        found.append(model.log_scales - model.log_scales.min() + np.float32(offset))
    binary = bytearray(path.with_suffix(".bin").read_bytes())
    (primitive,) = document["meshes"][0]["primitives"]
    scale = document["accessors"][primitive["attributes"][f"{gltf.GAUSSIAN_EXTENSION}:SCALE"]]
    document["meshes"][0]["primitives"] = []
    for logs in found:
        document["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": logs.nbytes})
        binary += logs.tobytes()
        document["accessors"].append(scale | {"bufferView": len(document["bufferViews"]) - 1})
        attributes = primitive["attributes"] | {f"{gltf.GAUSSIAN_EXTENSION}:SCALE": len(document["accessors"]) - 1}
        document["meshes"][0]["primitives"].append(primitive | {"attributes": attributes})
    document["buffers"][0]["byteLength"] = len(binary)
    document["asset"]["generator"] = generator
    path.with_suffix(".bin").write_bytes(binary)
    path.write_text(json.dumps(document))
    return found


@pytest.mark.brings("splat-transform before 2.7.0", ".glb with logs of scales, all over 0", "logs, by its generator")
@pytest.mark.parametrize(
    ("generator", "logs"),
    [
        *((f"splat-transform {version}", True) for version in ("2.5.0", "2.6.4", "v1.10.2")),
        *((f"splat-transform {version}", False) for version in ("2.7.0", "2.10.0", "3.0.1")),
        *((other, False) for other in ("a splat-transform 1.0", "splat-transform", None)),
    ],
)
def test_the_program_tells_what_its_scales_are(tmp_path: Path, generator: object, logs: bool) -> None:
    path = tmp_path / "model.gltf"
    (stored,) = generated(path, generator, 0.5)
    if not logs:
        np.testing.assert_allclose(formats.load(path).log_scales, np.log(stored), atol=1e-6)  # float32's
        return
    read = warned(f"are read as logs of scales, .* as {generator} wrote them", formats.load, path)
    np.testing.assert_array_equal(read.log_scales, stored)


def test_all_primitives_decide_together(tmp_path: Path) -> None:
    """One has logs that are all over 0, as a coarse level of detail does."""
    path = tmp_path / "model.gltf"
    stored = generated(path, "another", 0.5, -3.0)
    told = f"{path}: primitive 1 of node 0: Gaussian .* of 200 have a negative scale: all are read as logs of scales"
    np.testing.assert_array_equal(warned(told, formats.load, path).log_scales, np.concatenate(stored))
