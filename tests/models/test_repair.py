# SPDX-License-Identifier: Apache-2.0
"""Values that no Gaussian can have, or that seem to be meant otherwise: what is read, what is told, in every format."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import no_warnings, only, refuses, warned, warnings_of
from models import assert_equal, random_gaussians
from needs import require
from splats import lopsided, with_origin

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.models import edit, formats
from clsplat.models.codec import repair, values
from clsplat.models.formats import gltf, ply
from clsplat.shots.usd_models import read_stage

FLOATS = ["model.ply", "model.gltf", "model.usda"]
LEAST = np.float32(np.log(values.MIN_SCALE))


def written(path: Path, model: Gaussians) -> Path:
    """A file of a format of floats, with values that are refused when they are written."""
    if path.suffix.startswith(".usd"):
        require("pxr")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(values, "check_writable", lambda *_, **__: None)
        with np.errstate(invalid="ignore", over="ignore"):
            formats.save(path, model)
    return path


def told(path: Path) -> tuple[Gaussians, list[str]]:
    """The model, and the warnings without the path that each has."""
    read: list[Gaussians] = []
    texts = warnings_of(lambda: read.append(formats.load(path)))
    assert all(text.startswith(f"{path}: ") for text in texts), texts
    return read[0], [text.removeprefix(f"{path}: ") for text in texts]


def right(path: Path, meant: str) -> Gaussians:
    """The model as it is meant, without a warning; `meant` is what it is told that all of them are."""
    _, (text,) = told(path)
    assert text.startswith(f"all {meant} are between ")
    assert text.endswith(f"`clsplat convert --activated {meant}` writes a correct model")
    with no_warnings():
        return formats.load(path, activated=meant)


@pytest.mark.brings("any", "rows of NaN", "left out and counted")
@pytest.mark.parametrize(
    ("file", "name", "value", "what"),
    [
        *((file, "means", value, "a position") for file in FLOATS for value in (np.nan, -np.inf)),
        *((file, "log_scales", np.nan, "a scale") for file in FLOATS),
        *((file, "opacity_logits", np.nan, "an opacity") for file in FLOATS),
        *((file, "sh", np.inf, "a colour") for file in FLOATS),
        ("model.ply", "log_scales", np.inf, "a scale"),  # the writers of scales cut it
        ("model.ply", "quaternions", np.nan, "a rotation"),  # those of unit quaternions have none here
    ],
)
def test_gaussians_are_left_out(tmp_path: Path, file: str, name: str, value: float, what: str) -> None:
    model = lopsided(30, degree=1)
    getattr(model, name)[[4, 29]] = value
    path = written(tmp_path / file, model)
    read, texts = told(path)
    said = f"2 of 30 Gaussians have a value that is not finite, the first is {what} of Gaussian 4; they are left out"
    assert texts == [said]
    assert len(read) == 28
    np.testing.assert_array_equal(read.means, np.delete(model.means, [4, 29], axis=0))
    getattr(model, name)[:] = np.nan
    written(path, model)
    refuses(f"30 of 30 .* the first is {what} of Gaussian 0; expected at least one", formats.load, path)


@pytest.mark.brings("splat-transform", "scales of -inf, opacities of -inf and inf", "0, and 0 or 1")
@pytest.mark.parametrize("order", ["<", ">", "ascii"])
def test_infinite_values_that_stand_for_a_number(tmp_path: Path, order: str) -> None:
    """Flat, invisible and opaque Gaussians, in any encoding of a PLY."""
    model = random_gaussians(9, 0)
    model.opacity_logits[[0, 3]], model.opacity_logits[8] = np.inf, -np.inf
    model.log_scales[2, 1], model.log_scales[5] = -np.inf, -np.inf
    path = written(tmp_path / "model.ply", model)
    head, data = path.read_bytes().split(b"end_header\n")
    rows = np.frombuffer(data, "<f4")
    if order == "ascii":
        text = "\n".join(" ".join(map(repr, row)) for row in rows.reshape(9, -1).tolist())
        path.write_bytes(head.replace(b"binary_little_endian", b"ascii") + b"end_header\n" + text.encode())
    elif order == ">":
        path.write_bytes(head.replace(b"little", b"big") + b"end_header\n" + rows.astype(">f4").tobytes())
    read, texts = told(path)
    assert texts == []
    low, high = values.logits(np.array([0.0, 1.0]))
    np.testing.assert_array_equal(read.opacity_logits[[0, 3, 8]], [high, high, low])
    np.testing.assert_array_equal(read.log_scales[5], [LEAST] * 3)
    assert read.log_scales[2, 1] == LEAST
    np.testing.assert_array_equal(read.log_scales[2, [0, 2]], model.log_scales[2, [0, 2]])
    for name in ("again.glb", "again.splat"):  # what may not be infinite is written
        formats.save(tmp_path / name, read)
        assert formats.load(tmp_path / name).log_scales[5, 0] == LEAST


@pytest.mark.brings("SuperSplat", "compressed PLY with bounds of -inf", "flat Gaussians")
def test_infinite_bounds_of_chunks(tmp_path: Path) -> None:
    """What a writer that lets -inf pass makes of flat Gaussians: its arithmetic is NaN between the bounds, which is
    step 0, and right at the upper one."""
    model = random_gaussians(600, 0)
    path = tmp_path / "model.compressed.ply"
    formats.save(path, model)
    data = bytearray(path.read_bytes())
    at = data.index(b"end_header\n") + len(b"end_header\n")
    plain = formats.load(path)
    scale = at + 4 * 6  # of the first chunk: the least and the largest position, then the least log scale
    data[scale : scale + 4] = struct.pack("<f", -np.inf)
    path.write_bytes(data)
    read, texts = told(path)
    assert texts == []
    top = plain.log_scales[:256, 0] == plain.log_scales[:256, 0].max()
    np.testing.assert_array_equal(read.log_scales[:256, 0], np.where(top, plain.log_scales[:256, 0], LEAST))
    np.testing.assert_array_equal(read.log_scales[256:], plain.log_scales[256:])
    np.testing.assert_array_equal(read.log_scales[:, 1:], plain.log_scales[:, 1:])
    data[at : at + 4] = struct.pack("<f", np.nan)  # the least x
    path.write_bytes(data)
    read, texts = told(path)
    assert texts[0].startswith(
        "255 of 600 Gaussians have a value that is not finite, the first is a position of Gaussian 0"
    )
    at_the_other_end = plain.means[:256, 0].argmax()
    np.testing.assert_array_equal(read.means, plain.means[[at_the_other_end, *range(256, 600)]])


def test_far_from_the_origin_the_local_means_stay_those_of_their_rows(tmp_path: Path) -> None:
    model = with_origin(lopsided(20, degree=0), 4e5, 1e5, -50)
    local = model.means.copy()
    model.sh[7] = np.nan
    read, texts = told(written(tmp_path / "model.ply", model))
    assert len(texts) == 1
    np.testing.assert_array_equal(read.origin, model.origin)
    np.testing.assert_array_equal(read.means, np.delete(local, 7, axis=0))


def test_a_node_moves_what_is_left(tmp_path: Path) -> None:
    """As it would without those that are left out."""
    model, moved = lopsided(40, degree=1), {"translation": [3, 2, 1], "rotation": [0, 0.6, 0, 0.8]}
    found = []
    for spoilt in (False, True):
        if spoilt:
            model.means[0], model.means[5, 1] = np.inf, np.nan
        path = written(tmp_path / "model.gltf", model)
        document = json.loads(path.read_text())
        document["nodes"][0] |= moved
        path.write_text(json.dumps(document))
        read, texts = told(path)
        assert len(texts) == spoilt
        found.append(read)
    assert not found[1].origin.any()
    assert_equal(edit.take(found[0], np.delete(np.arange(40), [0, 5])), found[1])


def test_prims_of_a_stage(tmp_path: Path) -> None:
    """Each prim is told of by itself, and the two are moved."""
    require("pxr")
    from pxr import Gf, Usd, UsdGeom

    model = lopsided(20, degree=0)
    model.sh[[3, 4]], model.opacity_logits[0] = np.nan, np.inf
    path = written(tmp_path / "model.usda", model)
    stage = Usd.Stage.Open(str(path))
    shift = UsdGeom.Xformable(stage.GetPrimAtPath(formats.usd.WORLD_PRIM_PATH)).AddTranslateOp()
    shift.Set(Gf.Vec3d(0, 0, 0), 1)
    shift.Set(Gf.Vec3d(1, 0, 0), 5)
    stage.Save()
    models = warned(f"{path}: {formats.usd.GAUSSIANS_PRIM_PATH}: 2 of 20 .* a colour of Gaussian 3;", read_stage, path)
    np.testing.assert_array_equal(models.models[0].means, np.delete(model.means, [3, 4], axis=0))


def test_whole_numbers_of_the_gaussians_that_are_left(tmp_path: Path) -> None:
    """Semantic ids stay with their Gaussians."""
    model = random_gaussians(10, 0)
    model.means[0, 1], model.log_scales[6] = np.nan, np.inf
    model.opacity_logits[3] = -np.inf  # invisible, but there
    path = written(tmp_path / "model.ply", model)
    head, data = path.read_bytes().split(b"end_header\n")
    table = np.frombuffer(data, "<f4").reshape(10, -1)
    ids = np.arange(10, dtype=np.float32) * 100
    ids[6] = 0.5  # what is left out need not be whole
    table = np.column_stack([table, ids])
    path.write_bytes(head + b"property float label\nend_header\n" + table.astype("<f4").tobytes())
    assert len(warned("2 of 10 Gaussians", formats.load, path)) == 8
    assert ply.read_whole_numbers(path, "label").tolist() == [100, 200, 300, 400, 500, 700, 800, 900]


@pytest.mark.brings("any", "quaternions of 0", "no rotation, counted")
@pytest.mark.parametrize("file", ["model.ply", "model.gltf", "model.splat"])
def test_quaternions_of_no_length(tmp_path: Path, file: str) -> None:
    """0, what float32 squares to 0, what it squares to infinity, and a usual one."""
    model = random_gaussians(5, 0)
    model.quaternions[0], model.quaternions[4] = 0, 0
    path = tmp_path / "model.ply"
    model.quaternions[1], model.quaternions[2] = (3e-30, 0, 4e-30, 0), (0, -6e25, 8e25, 0)
    formats.save(path, model)
    read, texts = told(path)
    (text,) = texts
    assert text.startswith("2 of 5 Gaussians have a quaternion of 0, the first is Gaussian 0; they are drawn unrot")
    np.testing.assert_array_equal(read.quaternions[[0, 4]], [[1, 0, 0, 0]] * 2)
    np.testing.assert_allclose(read.quaternions[1:3], [[0.6, 0, 0.8, 0], [0, -0.6, 0.8, 0]], rtol=1e-6)  # float32's
    np.testing.assert_array_equal(read.quaternions[3], model.quaternions[3])
    other = tmp_path / file
    formats.save(other, read)
    again, texts = told(other)
    assert texts == []
    # 1/128 in a .splat's bytes
    unit = values.unit_quaternions(again.quaternions)
    np.testing.assert_allclose(unit, values.unit_quaternions(read.quaternions), atol=0.013)


def shifted(count: int, **arrays: Any) -> Gaussians:
    model = lopsided(count, degree=0)
    for name, array in arrays.items():
        setattr(model, name, np.asarray(array, np.float32))
    return model


RNG = np.random.default_rng(5)
LENGTHS = RNG.lognormal(-3, 1, (400, 3))
OPACITIES = {
    "of a network": RNG.uniform(0, 1, 400),
    "mostly opaque": np.r_[np.ones(390), RNG.uniform(0.9, 1, 10)],
    "levels": RNG.integers(0, 256, 400),
    "through bytes": values.byte_logits()[RNG.integers(127, 187, 400)],  # what other programs make of 0 to 1
}
SCALES = {
    "in metres": LENGTHS,
    "in millimetres": 1000 * LENGTHS,
    "flat": np.c_[LENGTHS[:, :2], np.zeros(400)],
    "all of two sizes": np.where(RNG.random((400, 3)) < 0.5, 0.01, 0.02),
}


@pytest.mark.brings("pixelSplat, mesh2splat", "opacities in place of logits", "named; `convert --activated`")
@pytest.mark.parametrize("name", OPACITIES)
def test_opacities_in_place_of_logits(tmp_path: Path, name: str) -> None:
    path = tmp_path / "model.ply"
    formats.save(path, shifted(400, opacity_logits=OPACITIES[name]))
    wanted = np.clip(OPACITIES[name] / (255 if name == "levels" else 1), 0, 1)
    np.testing.assert_allclose(
        values.opacities(right(path, "opacities").opacity_logits), wanted, atol=1e-6
    )  # float32's


@pytest.mark.brings("GPS-Gaussian", "scales in place of logs", "named; `convert --activated`")
@pytest.mark.parametrize("name", SCALES)
def test_scales_in_place_of_logs(tmp_path: Path, name: str) -> None:
    path = tmp_path / "model.ply"
    formats.save(path, shifted(400, log_scales=SCALES[name]))
    np.testing.assert_allclose(np.exp(right(path, "scales").log_scales), SCALES[name], rtol=1e-5, atol=1e-9)


def test_logits_and_logs_give_no_doubt(tmp_path: Path) -> None:
    """Models that come near it: in units so small that every scale is over 1; all opaque; all alike; few."""
    logs = RNG.normal(6, 1.2, (400, 3))
    path = tmp_path / "model.ply"
    for model in (
        shifted(400, log_scales=logs - logs.min()),
        shifted(400, log_scales=logs - logs.min() + 0.5, opacity_logits=RNG.uniform(0.1, 6, 400)),
        shifted(400, opacity_logits=np.full(400, 0.1), log_scales=np.full((400, 3), 0.1)),
        shifted(400, opacity_logits=np.r_[RNG.uniform(0, 1, 399), -0.1]),
        shifted(400, opacity_logits=np.r_[RNG.uniform(0, 1, 399), 1.1]),
        shifted(400, opacity_logits=RNG.integers(0, 12, 400)),
        shifted(400, opacity_logits=RNG.choice([0, 10, 100], 400)),
        shifted(99, opacity_logits=RNG.uniform(0, 1, 99), log_scales=LENGTHS[:99]),
        shifted(400, log_scales=np.r_[LENGTHS[:399], [[-0.1, 1, 1]]]),
    ):
        formats.save(path, model)
        assert told(path)[1] == []


def with_logs(path: Path, model: Gaussians, scales: np.ndarray) -> Path:
    """A .gltf or stage with these in place of scales."""
    formats.save(path, model)
    if path.suffix == ".gltf":
        document = json.loads(path.read_text())
        primitive = document["meshes"][0]["primitives"][0]
        view = document["accessors"][primitive["attributes"]["KHR_gaussian_splatting:SCALE"]]["bufferView"]
        with path.with_suffix(".bin").open("r+b") as file:
            file.seek(document["bufferViews"][view]["byteOffset"])
            file.write(scales.astype("<f4").tobytes())
    elif path.suffix == ".splat":
        rows = np.frombuffer(path.read_bytes(), formats.splat.SPLAT_RECORD).copy()
        rows["scales"] = scales
        path.write_bytes(rows.tobytes())
    else:
        from pxr import Usd, Vt

        stage = Usd.Stage.Open(str(path))
        stage.GetPrimAtPath(formats.usd.GAUSSIANS_PRIM_PATH).GetAttribute("scales").Set(Vt.Vec3fArray.FromNumpy(scales))
        stage.Save()
    return path


@pytest.mark.brings("splat-transform", ".glb with logs of scales", "logs, with a warning")
@pytest.mark.parametrize("file", ["model.gltf", "model.splat", "model.usda"])
@pytest.mark.parametrize("offset", [0.0, 4.0])
def test_negative_scales_are_logs(tmp_path: Path, file: str, offset: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of all Gaussians, those of other blocks of rows too; in larger units most are over 0."""
    if file.endswith(".usda"):
        require("pxr")
    monkeypatch.setattr(values, "IO_BLOCK_ROWS", 64)
    model = lopsided(300, degree=0)
    model.log_scales += offset
    model.log_scales[:50] = np.abs(model.log_scales[:50])
    path = with_logs(tmp_path / file, model, model.log_scales)
    read, texts = told(path)
    np.testing.assert_array_equal(read.log_scales, model.log_scales)
    assert len(texts) == 1
    assert "have a negative scale: all are read as logs of scales, although this format stores scales" in texts[0]
    few = np.exp(model.log_scales)
    few[7, 2] = -1
    with pytest.raises(InputError, match=r"Gaussian 7 has the scales .* -1, expected .* at least 0; 1 of 300 has"):
        formats.load(with_logs(path, model, few))


@pytest.mark.parametrize("kernel", ["sphere", "2d", 3])
def test_a_kernel_that_is_not_known_is_drawn_as_an_ellipse(tmp_path: Path, kernel: object) -> None:
    path, model = tmp_path / "model.gltf", lopsided(20, degree=1)
    gltf.write(path, model)
    wanted = formats.load(path)
    document = json.loads(path.read_text())
    document["meshes"][0]["primitives"][0]["extensions"][gltf.GAUSSIAN_EXTENSION]["kernel"] = kernel
    path.write_text(json.dumps(document))
    read, texts = told(path)
    assert only(texts).startswith(
        f"primitive 0 of node 0 has the kernel {str(kernel)!r}, expected ellipse; it is drawn as an ellipse"
    )
    assert_equal(read, wanted)


def test_ordinary_models_keep_their_bits() -> None:
    model = random_gaussians(1000, 3)
    before = edit.take(model, np.arange(1000))
    with no_warnings():
        assert repair.repaired(model, "model") is model
    assert_equal(model, before)
