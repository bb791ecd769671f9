# SPDX-License-Identifier: Apache-2.0
"""A .zip that holds one model, as downloads have it."""

from __future__ import annotations

import json
import random
import zipfile
from pathlib import Path

import numpy as np
import pytest
from calls import Capture, error_line, no_warnings, printed, refuses, warned
from models import assert_equal, random_gaussians
from needs import require
from quick import quick
from splats import assert_refused_or_sound

from clsplat.cli.main import main
from clsplat.errors import InputError
from clsplat.images.colour import comment
from clsplat.models import formats
from clsplat.models.formats import zipped

MODELS = ["model.ply", "model.compressed.ply", "model.spz", "model.sog", "model.glb", "model.splat", "model.usdz"]


def packed(path: Path, files: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return path


@pytest.mark.brings("browsers, Finder", ".zip of one model", "the model")
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("place", quick(["", "scan 3/export/"], "scan 3/export/"))
def test_any_model_in_a_zip(tmp_path: Path, name: str, place: str) -> None:
    if name.endswith("usdz"):
        require("pxr")
    path = tmp_path / name
    formats.save(path, random_gaussians(300, 1))
    added = {f"__MACOSX/{place}._{name}": b"x", f"{place}.hidden.ply": b"x", f"{place}readme.txt": b"a model"}
    archive = packed(tmp_path / "a download.zip", added | {place + name: path.read_bytes()})
    with no_warnings():
        assert_equal(formats.load(archive), formats.load(path))


@pytest.mark.parametrize("compression", [zipfile.ZIP_STORED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
@pytest.mark.parametrize("name", ["meta.json", "model.gltf"])
def test_a_model_of_several_files(tmp_path: Path, name: str, compression: int) -> None:
    folder = tmp_path / "model"
    folder.mkdir()
    formats.save(folder / name, random_gaussians(300, 1))
    files = {f"model/{file.name}": file.read_bytes() for file in folder.iterdir()}
    assert len(files) > 1
    archive = packed(tmp_path / "model.zip", files, compression)
    assert_equal(formats.load(archive), formats.load(folder / name))
    packed(archive, {file.partition("/")[2]: data for file, data in files.items()})
    assert_equal(formats.load(archive), formats.load(folder / name))


def test_verbs_take_it(tmp_path: Path, capsys: Capture) -> None:
    model = random_gaussians(300, 2)
    model.antialiased, model.near = True, 0.5
    model.save(tmp_path / "model.ply", comments=[comment("lin_rec709")])
    archive = packed(tmp_path / "model.zip", {"x/model.ply": (tmp_path / "model.ply").read_bytes()})
    said = json.loads(printed(capsys, ["info", archive, "--json"]).out)
    plain = json.loads(printed(capsys, ["info", tmp_path / "model.ply", "--json"]).out)
    other = {"path": str(archive), "bytes": archive.stat().st_size, "format": "3DGS PLY in a .zip"}
    assert said == plain | other
    assert "3DGS PLY in a .zip" in printed(capsys, ["info", archive]).out
    assert printed(capsys, ["convert", archive, tmp_path / "again.ply"]).err == ""
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "model.ply").read_bytes()
    assert main(["convert", str(archive), str(tmp_path / "new.zip")]) == 2
    assert "new.zip: zipped model files cannot be written, expected one of " in error_line(capsys)


def test_what_is_wrong_with_the_model_names_the_archive(tmp_path: Path) -> None:
    path, model = tmp_path / "model.ply", random_gaussians(3, 0)
    formats.save(path, model)
    data = path.read_bytes()
    archive = packed(tmp_path / "model.zip", {"x/model.ply": data + b"123"})
    assert_equal(
        warned(rf"{archive}: x/model\.ply: 3 bytes after the last Gaussian are ignored", formats.load, archive), model
    )
    packed(archive, {"x/model.ply": data[:-1]})
    with pytest.raises(InputError, match=rf"{archive}: x/model\.ply: truncated: has 2 of 3 Gaussians") as trouble:
        formats.load(archive)
    assert "clsplat-" not in str(trouble.value)  # the folder that it was unpacked to


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({"1.ply": b"ply scale_0", "b/2.SPLAT": b"x"}, r"contains 2 model files \(1\.ply, b/2\.SPLAT\), expected one"),
        ({f"{i}.ply": b"ply" for i in range(5)}, r"contains 5 model files \(0\.ply, 1\.ply, 2\.ply and 2 more\), exp"),
        ({"readme.txt": b"x", "__MACOSX/._a.ply": b"x"}, "contains 0 model files, expected one"),
        ({"a.zip": b"PK"}, "contains 0 model files, expected one"),
        ({}, "contains 0 model files, expected one"),
        ({"a.ply": b"not one"}, r"a\.ply: not a PLY file"),
        ({"a.splat": b""}, r"a\.splat: has 0 bytes"),
    ],
)
def test_one_model_or_a_line(tmp_path: Path, files: dict[str, bytes], message: str) -> None:
    archive = packed(tmp_path / "some.zip", files)
    refuses(rf"{archive}: {message}", formats.load, archive)


def test_bombs_encryption_and_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    archive = packed(tmp_path / "bomb.zip", {"a.ply": bytes(100 << 20)})
    refuses(r"bomb\.zip: has 104,857,600 bytes unpacked, expected at most 67,108,864", formats.load, archive)
    path = tmp_path / "model.ply"
    formats.save(path, random_gaussians(200, 1))
    data = bytearray(packed(archive, {"a.ply": path.read_bytes()}).read_bytes())
    for signature, at in ((b"PK\x01\x02", 8), (b"PK\x03\x04", 6)):
        data[data.index(signature) + at] |= zipped.ENCRYPTED_FLAG
    archive.write_bytes(data)
    refuses(r"is encrypted, expected a \.zip without a password", formats.load, archive)
    archive.write_bytes(b"PK\x03\x04 something else")
    refuses(r"bomb\.zip: does not unpack \(File is not a zip file\); is it damaged", formats.load, archive)
    monkeypatch.setattr(zipped, "MAX_ARCHIVE_FILES", 3)
    refuses("has more than 3 files", formats.load, packed(archive, {f"{i}.txt": b"" for i in range(4)}))


@pytest.mark.parametrize("compression", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_damage_anywhere(tmp_path: Path, compression: int) -> None:
    path, rng = tmp_path / "model.ply", random.Random(4)
    formats.save(path, random_gaussians(30, 0))
    archive = packed(tmp_path / "model.zip", {"x/model.ply": path.read_bytes()}, compression)
    whole, refused = archive.read_bytes(), 0
    for _ in range(60):
        data = bytearray(whole)
        at = rng.randrange(len(data))
        if rng.random() < 0.3:
            del data[at:]
        else:
            data[at] ^= 1 << rng.randrange(8)
        archive.write_bytes(data)
        refused += assert_refused_or_sound(formats.load, archive)
    assert refused > 40  # every cut, and most changes: zip has sums


@pytest.mark.brings("any", "zip of a PLY named .ply or .sog", "the model")
@pytest.mark.parametrize("name", ["x.ply", "x.sog", "x", "x.splat"])
def test_the_files_of_an_archive_tell_what_it_is(tmp_path: Path, name: str) -> None:
    """Whatever its own name is; a .zip needs no word."""
    path = tmp_path / "model.ply"
    formats.save(path, random_gaussians(3, 0))
    other = packed(tmp_path / name, {"a/model.ply": path.read_bytes(), "a/meta.json": b'{"title": "a scan"}'})
    read = warned(rf"{name}: is zipped model by its content, in spite of its name", formats.load, other)
    np.testing.assert_array_equal(read.means, formats.load(path).means)
    with no_warnings():
        np.testing.assert_array_equal(formats.load(other.rename(tmp_path / "m.ZIP")).means, formats.load(path).means)


def test_an_archive_of_sog_is_one_by_any_name(tmp_path: Path) -> None:
    path = tmp_path / "model.sog"
    formats.save(path, random_gaussians(30, 1))
    wanted = formats.load(path)
    for name in ("x.ply", "x"):
        other = path.rename(tmp_path / name)
        assert_equal(warned(f"{name}: is SOG by its content", formats.load, other), wanted)
        path = other
    for name in ("model.sog", "b.zip"):
        with zipfile.ZipFile(path) as source:
            files = {f"export/{member}": source.read(member) for member in source.namelist()}
        with no_warnings():
            assert_equal(formats.load(packed(tmp_path / name, files)), wanted)
    empty = packed(tmp_path / "none.sog", {"readme.txt": b"x"})
    refuses(r"does not contain meta\.json", formats.load, empty)
    with pytest.raises(InputError, match=r"meta\.json has no key 'means', expected the meta\.json of a SOG model"):
        formats.load(packed(empty, {"meta.json": b'{"title": "a scan"}'}))


@pytest.mark.brings("viewers' downloads", ".zip with a point cloud, a mesh, a meta.json beside the model", "the model")
@pytest.mark.parametrize(
    "beside",
    [
        {"meta.json": b'{"name": "scan", "date": 1}'},
        {"mesh.glb": b"glTF" + bytes(20), "mesh.gltf": b'{"asset": {"version": "2.0"}}'},
        {"input.ply": b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n"},
    ],
)
@pytest.mark.parametrize("name", ["model.ply", "model.compressed.ply", "model.splat", "model.sog"])
def test_files_without_gaussians_are_no_models(tmp_path: Path, name: str, beside: dict[str, bytes]) -> None:
    path = tmp_path / name
    formats.save(path, random_gaussians(300, 0))
    archive = packed(tmp_path / "all.zip", {**beside, f"run/{name}": path.read_bytes()})
    with no_warnings():
        assert_equal(formats.load(archive), formats.load(path))
    both = packed(tmp_path / "two.zip", {f"{at}/{name}": path.read_bytes() for at in (7000, 30000)} | beside)
    refuses(rf"contains 2 model files \(7000/{name}, 30000/{name}\)", formats.load, both)
