# SPDX-License-Identifier: Apache-2.0
"""Cryptomattes of objects and of semantic ids: the ids against published values, coverage against the float64 twin."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from calls import Capture, error_line, fails, ran
from cg import write_flat
from rendered import camera_file
from tiny import HEIGHT, WIDTH, hidden_model

from clsplat.arrays import Float32, Float64
from clsplat.camera import Camera
from clsplat.cli.main import main
from clsplat.gaussians import Gaussians
from clsplat.images.cryptomatte import header_of, id_bits, murmur3, ranked
from clsplat.models import edit
from clsplat.reference.blend import layers
from clsplat.reference.holdout import Surface, let_through
from clsplat.reference.render import forward

MODEL = hidden_model()
A, B = edit.take(MODEL, slice(0, 15)), edit.take(MODEL, slice(15, 40))
SPHERE, BOX = [0.2, 0.1, 0.0, 0.6], [-2, -2, -2, 0, 2, 2]
CLOSE = 2e-5
"""Float32's blending, as of a picture."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mattes")
    A.save(folder / "a.ply")
    B.save(folder / "b.ply")
    camera_file(folder / "cameras.json", {1: 0, 2: 0.5})
    mattes = [{"name": "ball", "sphere": SPHERE}, {"name": "left", "box": BOX}]
    models = [{"name": "a", "path": "a.ply"}, {"name": "b ü", "path": "b.ply", "mattes": mattes}]
    (folder / "shot.json").write_text(json.dumps({"clsplat_shot": 1, "models": models}))
    return folder


FOCAL = 0.5 * WIDTH / np.tan(np.radians(30))


def camera_at(frame: float) -> Camera:
    rows = (np.eye(3), np.array([-0.5 * (frame - 1), 0.0, 4.0]))
    return Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, *rows)


def render(folder: Path, out: Path, flags: str, model: str = "shot.json") -> int:
    words = ["render", str(folder / model), "--cameras", str(folder / "cameras.json"), "-o", str(out / "#.exr")]
    return main([*words, "--frames", "1", "--progress", "none", *flags.split()])


def read(path: Path, layer: str) -> tuple[Float32, dict[str, str]]:
    """(H, W, 12) of a Cryptomatte, and its metadata."""
    image = oiio.ImageBuf(str(path))
    for index in range(image.nsubimages):
        part = oiio.ImageBuf(str(path), index, 0)
        names = [f"{layer}{number:02d}.{channel}" for number in range(3) for channel in "RGBA"]
        if names[0] in part.spec().channelnames:
            pixels = part.get_pixels(oiio.FLOAT)
            key = f"cryptomatte/{murmur3(layer.encode()):08x}"[:19]
            found = {a.name.split("/")[2]: a.value for a in part.spec().extra_attribs if a.name.startswith(key)}
            return pixels[:, :, [part.spec().channelnames.index(name) for name in names]], found
    raise AssertionError(f"no {layer}")


def coverage(pixels: Float32, name: str) -> Float64:
    """Coverage of a name, as a program that reads a Cryptomatte adds it up."""
    pairs = pixels.reshape(HEIGHT, WIDTH, 6, 2)
    of = np.ascontiguousarray(pairs[:, :, :, 0]).view(np.uint32) == id_bits(name)
    return np.where(of, pairs[:, :, :, 1], 0).sum(axis=2, dtype=np.float64)


def by_hand(
    model: Gaussians, owners: np.ndarray, count: int, camera: Camera, surfaces: Sequence[Surface] = ()
) -> Float64:
    """(H, W, count): the sums of the weights, in float64; surfaces: of a holdout."""
    shares, projected = np.zeros((HEIGHT, WIDTH, count)), forward(model, camera).projected
    for layer in layers(projected, WIDTH, HEIGHT):
        weight = np.where(layer.added, layer.before * layer.alpha, 0.0)
        if surfaces:
            weight *= let_through(surfaces, float(np.float32(projected.depths[layer.gaussian])))[layer.box]
        shares[(*layer.box, owners[layer.gaussian])] += weight
    return shares


def owners() -> np.ndarray:
    """Of the shot: a, b, ball, left."""
    in_ball = np.linalg.norm(B.means - SPHERE[:3], axis=1) <= SPHERE[3]
    assert 2 < in_ball.sum() < 23 and (~in_ball & (B.means[:, 0] <= 0)).sum() > 2
    of_b = np.where(in_ball, 2, np.where(B.means[:, 0] <= 0, 3, 1))
    return np.concatenate([np.zeros(len(A), int), of_b])


NAMES = ("a", "b ü", "ball", "left")


def test_hashes() -> None:
    # Values of other implementations.
    for text, wanted in (("", 0), ("test", 0xBA6BD213), ("Hello, world!", 0xC0363E43), ("abc", 0xB3DD93FA)):
        assert murmur3(text.encode()) == wanted, text
    assert murmur3(b"The quick brown fox jumps over the lazy dog") == 0x2E4FF723
    assert id_bits("test") == 0xBA6BD213
    for index in range(2000):
        value = np.array([id_bits(f"object {index}")], np.uint32).view(np.float32)[0]
        assert np.isfinite(value) and abs(value) >= np.finfo(np.float32).tiny
    (name, *_), keys = header_of("cryptoobject", ["a"]).values(), list(header_of("cryptoobject", ["a"]))
    assert name == "cryptoobject"
    assert keys[0] == f"cryptomatte/{murmur3(b'cryptoobject'):08x}"[:19] + "/name"


def test_ranks() -> None:
    shares = np.zeros((1, 3, 8), np.float32)
    shares[0, 0] = [0.05, 0.3, 0.1, 0.02, 0.15, 0.2, 0.01, 0.17]
    shares[0, 1, 4] = 1
    names = [f"n{index}" for index in range(8)]
    found = ranked(shares, names).reshape(3, 6, 2)
    ids = np.array([id_bits(name) for name in names], np.uint32).view(np.float32)
    np.testing.assert_array_equal(found[0, :, 0], ids[[1, 5, 7, 4, 2, 0]])
    np.testing.assert_array_equal(found[0, :, 1], np.float32([0.3, 0.2, 0.17, 0.15, 0.1, 0.05]))
    np.testing.assert_array_equal(found[1], [[ids[4], 1], *[[0, 0]] * 5])
    assert not found[2].any()


@pytest.mark.parametrize("flags", ["", "--parts several --exr half"])
def test_objects_cover_what_their_gaussians_do(flags: str, folder: Path, tmp_path: Path) -> None:
    assert render(folder, tmp_path, f"--channels rgb,alpha,objects {flags}") == 0
    pixels, found = read(tmp_path / "1.exr", "cryptoobject")
    wanted = by_hand(edit.merge([A, B]), owners(), 4, camera_at(1))
    for index, name in enumerate(NAMES):
        assert np.abs(coverage(pixels, name) - wanted[:, :, index]).max() < CLOSE, name
        assert wanted[:, :, index].max() > 0.2
    assert (found["name"], found["hash"]) == ("cryptoobject", "MurmurHash3_32")
    assert found["conversion"] == "uint32_to_float32"
    assert json.loads(found["manifest"]) == {name: f"{id_bits(name):08x}" for name in NAMES}
    assert (np.diff(pixels[:, :, 1::2], axis=2) <= 0).all()


def test_coverage_of_a_shutter_is_the_mean(folder: Path, tmp_path: Path) -> None:
    shutter = "--shutter-open 0 --shutter-close 1 --samples 4"
    assert render(folder, tmp_path, f"--channels objects {shutter}") == 0
    pixels, _ = read(tmp_path / "1.exr", "cryptoobject")
    merged = edit.merge([A, B])
    frames = [by_hand(merged, owners(), 4, camera_at(1 + (index + 0.5) / 4)) for index in range(4)]
    for index, name in enumerate(NAMES):
        assert np.abs(coverage(pixels, name) - np.mean(frames, axis=0)[:, :, index]).max() < CLOSE, name


def test_objects_held_out_cover_what_is_seen(folder: Path, tmp_path: Path) -> None:
    """A wall in the midst of the models, of glass at the left and opaque at the right."""
    depth = np.full((HEIGHT, WIDTH), 4.0)
    opaque = np.broadcast_to(np.linspace(0, 1, WIDTH, dtype=np.float32).astype(np.float64), depth.shape)
    held = f"--holdout {write_flat(tmp_path / 'wall.exr', {'Z': depth, 'A': opaque})}"
    assert render(folder, tmp_path, f"--channels objects,alpha,depth {held}") == 0
    pixels, _ = read(tmp_path / "1.exr", "cryptoobject")
    model = (edit.merge([A, B]), owners(), 4, camera_at(1))
    wanted, whole = by_hand(*model, [(depth, depth, opaque)]), by_hand(*model)
    for index, name in enumerate(NAMES):
        assert np.abs(coverage(pixels, name) - wanted[:, :, index]).max() < CLOSE, name
        assert np.abs(whole - wanted)[:, :, index].max() > 0.04
    alpha = oiio.ImageBuf(str(tmp_path / "1.exr")).get_pixels(oiio.FLOAT)[:, :, 0]
    assert np.abs(sum(coverage(pixels, name) for name in NAMES) - alpha).max() < CLOSE


def labelled(path: Path, ids: Any) -> None:
    """The PLY of A with a property of whole numbers."""
    A.save(path)
    head, body = path.read_bytes().split(b"end_header\n")
    rows = np.frombuffer(body, np.uint8).reshape(len(A), -1)
    more = np.asarray(ids, "<i4").reshape(-1, 1).view(np.uint8)
    path.write_bytes(head + b"property int label\nend_header\n" + np.concatenate([rows, more], axis=1).tobytes())


def test_semantic_ids(folder: Path, tmp_path: Path) -> None:
    ids = np.arange(len(A)) % 11 * 3 - 3  # 11 of them: two passes of eight
    labelled(folder / "ids.ply", ids)
    assert render(folder, tmp_path, "--channels semantic,objects --ids-from label", "ids.ply") == 0
    pixels, found = read(tmp_path / "1.exr", "cryptosemantic")
    assert list(json.loads(found["manifest"])) == [str(number) for number in range(-3, 30, 3)]
    wanted = by_hand(A, (ids + 3) // 3, 11, camera_at(1))
    largest = np.sort(wanted, axis=2)[:, :, -6:]
    total = sum(coverage(pixels, str(number)) for number in range(-3, 30, 3))
    assert np.abs(total - largest.sum(axis=2)).max() < CLOSE
    one = coverage(pixels, "0")
    seen = wanted[:, :, 1] > largest[:, :, 0]
    assert np.abs(one - wanted[:, :, 1])[seen].max() < CLOSE and seen.sum() > 20
    assert list(json.loads(read(tmp_path / "1.exr", "cryptoobject")[1]["manifest"])) == ["ids"]


@pytest.mark.parametrize("compression", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_ids_of_a_zipped_ply(compression: int, folder: Path, tmp_path: Path) -> None:
    labelled(folder / "zipped.ply", np.arange(15) % 3 + 5)
    with zipfile.ZipFile(folder / "zipped.zip", "w", compression) as archive:
        archive.write(folder / "zipped.ply", "scan/zipped.ply")
    found = []
    for name in ("zipped.ply", "zipped.zip"):
        assert render(folder, tmp_path / name, "--channels semantic --ids-from label", name) == 0
        found.append(read(tmp_path / name / "1.exr", "cryptosemantic"))
    assert list(json.loads(found[1][1]["manifest"])) == ["5", "6", "7"]
    np.testing.assert_array_equal(found[0][0], found[1][0])


def test_skip_existing_sees_the_mattes(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    def skipped(ids: Any) -> bool:
        labelled(folder / "changing.ply", ids)
        capsys.readouterr()
        flags = "--channels semantic --ids-from label --skip-existing --json"
        return bool(json.loads(ran(capsys, render, folder, tmp_path, flags, "changing.ply").out)[0]["skipped"])

    assert [skipped(np.arange(15) % 3), skipped(np.arange(15) % 3), skipped(np.arange(15) % 4)] == [False, True, False]


@pytest.mark.parametrize(
    ("flags", "model", "message"),
    [
        ("--channels semantic", "a.ply", "--channels semantic: expected --channels semantic and --ids-from together"),
        ("--channels rgb --ids-from x", "a.ply", "--ids-from x: expected --channels semantic"),
        ("--channels semantic --ids-from label", "a.ply", "a.ply: PLY has no property label, expected one of x, y"),
        ("--channels semantic --ids-from opacity", "a.ply", "the property opacity has values that are not whole"),
        ("--channels objects --compression dwaa", "a.ply", "--compression dwaa: changes the ids of --channels objects"),
        ("--channels rgb,alpha,objects --deep", "a.ply", "objects"),
    ],
)
def test_wrong_mattes_are_one_line(
    flags: str, model: str, message: str, folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    assert message in fails(capsys, render, folder, tmp_path / "none", flags, model)


@pytest.mark.parametrize(
    ("mattes", "message"),
    [
        ([], "'mattes' is [], expected a list of at least one object"),
        ([{"name": "m"}], "model 'a': matte 0: has no region, expected exactly one of 'box', 'sphere' and 'mesh'"),
        ([{"name": "m", "mesh": "none.obj"}], "none.obj: no such file"),
        ([{"name": "m", "box": [1, 0, 0, 0, 1, 1]}], "'box' is [1, 0, 0, 0, 1, 1], expected the least x, y and z"),
        ([{"name": "m", "sphere": [0, 0, 0, -1]}], "expected x, y, z and a radius of at least 0"),
        ([{"name": "a", "sphere": [0, 0, 0, 1]}], "has the matte 'a', a name that is used twice"),
    ],
)
def test_wrong_volumes_are_one_line(mattes: Any, message: str, folder: Path, tmp_path: Path, capsys: Capture) -> None:
    shot = {"clsplat_shot": 1, "models": [{"name": "a", "path": "a.ply", "mattes": mattes}]}
    (folder / "wrong.json").write_text(json.dumps(shot))
    assert message in fails(capsys, render, folder, tmp_path / "none", "--channels objects", "wrong.json")


def test_far_more_objects_than_a_matte_has(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    many = replace(A, **{name: np.repeat(array, 20, axis=0) for name, array in A.arrays().items()})
    volumes = [{"name": f"v{index}", "sphere": [index, 0, 0, 1]} for index in range(300)]
    many.save(folder / "many.ply")
    shot = {"clsplat_shot": 1, "models": [{"name": "a", "path": "many.ply", "mattes": volumes}]}
    (folder / "many.json").write_text(json.dumps(shot))
    assert render(folder, tmp_path / "none", "--channels objects", "many.json") == 2
    assert "--channels objects: has 301 objects, expected at most 256" in error_line(capsys)


def test_a_plan_knows_the_strips_of_many_objects(
    folder: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    objects, rows, flags = 4, 16, f"--channels objects --width {4 * WIDTH} --dry-run --json"
    monkeypatch.setattr("clsplat.sequence.frame_renderer.DEEP_STRIP_FLOATS", objects * 4 * WIDTH * rows)
    plan = json.loads(ran(capsys, render, folder, tmp_path, flags).out)
    assert plan["devices"][0]["strips"] == -(-4 * HEIGHT // rows)


def test_a_mesh_is_a_volume(folder: Path, tmp_path: Path) -> None:
    """A box as a mesh, from the shot's folder: the matte of the box."""
    low, high = np.array(BOX[:3]), np.array(BOX[3:])
    points = [np.where([index & 1, index & 2, index & 4], high, low) for index in range(8)]
    faces = ["1 3 4 2", "5 6 8 7", "1 2 6 5", "3 7 8 4", "1 5 7 3", "2 4 8 6"]
    lines = [f"v {x} {y} {z}" for x, y, z in points] + [f"f {face}" for face in faces]
    (folder / "box.obj").write_text("\n".join(lines))
    found = []
    for volume in ({"box": BOX}, {"mesh": "box.obj"}):
        shot = {"clsplat_shot": 1, "models": [{"name": "a", "path": "a.ply", "mattes": [{"name": "left", **volume}]}]}
        (folder / "mesh.json").write_text(json.dumps(shot))
        assert render(folder, tmp_path, "--channels objects --overwrite", "mesh.json") == 0
        found.append(coverage(read(tmp_path / "1.exr", "cryptoobject")[0], "left"))
    assert found[0].max() > 0.2
    np.testing.assert_array_equal(*found)
