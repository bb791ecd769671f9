# SPDX-License-Identifier: Apache-2.0
"""SOG: what comes back, what others read and write, version 1, and damage."""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import complaint, no_warnings, peak_of, refuses, warned
from models import assert_equal, real_file
from node import splat_transform
from splats import (
    assert_refused_or_sound,
    assert_within,
    lopsided,
    losses,
    opacity,
    read_plainly,
    refused_of,
    with_origin,
)
from systems import links

from clsplat.gaussians import Gaussians
from clsplat.models import formats
from clsplat.models.codec import values as packing
from clsplat.models.codec.palette import codebook, nearest, palette
from clsplat.models.formats import format_of, sog
from clsplat.models.info import size

SAME = {"means": 2e-6, "rotations": 2e-6, "log_scales": 0, "sh0": 0, "sh": 0, "opacities": 0.0011}
"""float32's rounding; opacities of 0 and 255 count as a quarter of a step from the end here, as the end there."""


def spread(gaussians: Gaussians) -> dict[str, float]:
    """What each attribute may lose: half a step of 16 bits in ln(1 + |x|); of 255 in +-sqrt(1/2), in the three
    components that are there and once more in the one that follows, twice that as an angle; 1/64 of the range where a
    codebook of 256 is spread by density, of which 64 would be a uniform one's; opacity half a step."""
    folded = np.log1p(np.abs(gaussians.means + gaussians.origin)).max() * 2 / 65535 / 2
    return {
        "means": float(folded * (1 + np.abs(gaussians.means).max())),
        "rotations": 2 * 2 * 3**0.5 * 2**0.5 / 255 / 2,
        "log_scales": float(np.ptp(gaussians.log_scales)) / 64 / 2,
        "opacities": 0.5 / 255 * 1.001,
    }


def visible(gaussians: Gaussians) -> Gaussians:
    """Without those whose opacity rounds to 0, which have no colour in the file."""
    kept = opacity(gaussians) >= 0.5 / 255
    arrays = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
    return Gaussians(*(getattr(gaussians, name)[kept] for name in arrays))


@pytest.mark.parametrize("name", ["model.sog", "meta.json"])
@pytest.mark.parametrize("degree", range(4))
def test_it_comes_back_with_the_stated_loss(tmp_path: Path, name: str, degree: int) -> None:
    model, path = visible(lopsided(degree=degree)), tmp_path / name
    sog.write(path, model)
    back = sog.read(path)
    assert_within(back, model, **spread(model), sh0=float(np.ptp(model.sh[:, 0])) / 64 / 2)
    assert sog.describe(path) == {"version": 2, "antialiased": False}
    if degree:
        # a palette of 256 for 500 random vectors, the worst that there is: no better than their middle, but no worse
        error = np.square(back.sh[:, 1:] - model.sh[:, 1:]).mean()
        assert error < np.square(model.sh[:, 1:] - model.sh[:, 1:].mean(axis=0)).mean() * (0.8 if degree > 1 else 0.3)


def test_a_folder_is_a_model(tmp_path: Path) -> None:
    model = lopsided(50)
    sog.write(tmp_path / "meta.json", model)
    sog.write(tmp_path / "model.sog", model)
    assert_within(sog.read(tmp_path), sog.read(tmp_path / "model.sog"), **dict.fromkeys(SAME, 0))


def test_sorted_it_is_the_same_model_and_smaller(tmp_path: Path) -> None:
    model = lopsided(5000, degree=0)
    for sort in (False, True):
        sog.write(tmp_path / f"{sort}.sog", model, sort=sort)
    plain, ordered = sog.read(tmp_path / "False.sog"), sog.read(tmp_path / "True.sog")
    order = packing.morton_order(model.means)
    np.testing.assert_array_equal(ordered.means, plain.means[order])
    np.testing.assert_array_equal(ordered.quaternions, plain.quaternions[order])
    sizes = [(tmp_path / f"{sort}.sog").stat().st_size for sort in (False, True)]
    assert sizes[1] < sizes[0] * 0.97  # only positions are smooth here


@pytest.mark.parametrize("name", ["5_0", "6_0"])
def test_samples_are_what_another_reader_has(tmp_path: Path, name: str) -> None:
    path = real_file(f"samples/sog/{name}/meta.json")
    splat_transform(path, tmp_path / "other.ply")
    assert_within(sog.read(path), read_plainly(tmp_path / "other.ply"), **SAME)


@pytest.mark.parametrize("name", ["model.sog", "meta.json"])
def test_another_reader_has_the_same_values(tmp_path: Path, name: str) -> None:
    sog.write(tmp_path / name, with_origin(lopsided(), 100, -50, 3))
    splat_transform(tmp_path / name, tmp_path / "other.ply")
    there = read_plainly(tmp_path / "other.ply")
    assert_within(sog.read(tmp_path / name), there, **SAME | {"means": 2e-5})  # float32 near 100


def test_what_another_writes_is_the_same_model(tmp_path: Path) -> None:
    model = visible(lopsided(degree=0))  # palettes of its making are in the samples
    model.save(tmp_path / "model.ply")
    splat_transform(tmp_path / "model.ply", tmp_path / "theirs.sog")
    theirs = sog.read(tmp_path / "theirs.sog")
    near = np.argmin(np.linalg.norm(model.means[:, None] - theirs.means[None], axis=2), axis=1)  # it sorts
    assert len(set(near)) == len(model)
    arrays = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
    found = losses(Gaussians(*(getattr(theirs, name)[near] for name in arrays)), model)
    bounds = spread(model)
    # it cuts where we round, so that a whole step may be lost
    assert found["means"] <= 2 * bounds["means"]
    assert found["rotations"] <= 2 * bounds["rotations"]
    assert found["opacities"] <= 1.1 / 255
    assert found["log_scales"] < 0.1
    assert found["sh0"] < 0.1


def as_version_1(folder: Path) -> dict[str, Any]:
    """A meta.json of version 2 told as version 1 would; bytes are then steps of ranges."""
    meta = json.loads((folder / "meta.json").read_text())
    count = meta.pop("count")
    del meta["version"]
    meta["means"]["shape"] = [count, 3]
    meta["scales"] = {"mins": [-6, -5, -4], "maxs": [-1, -2, -3], "files": meta["scales"]["files"]}
    meta["sh0"] = {"mins": [-1, -2, -3, -4], "maxs": [1, 2, 3, 4], "files": meta["sh0"]["files"]}
    meta["shN"] = {"mins": -0.5, "maxs": 0.75, "quantization": 8, "files": meta["shN"]["files"]}
    (folder / "meta.json").write_text(json.dumps(meta))
    return dict(meta)


def test_version_1(tmp_path: Path) -> None:
    sog.write(tmp_path / "meta.json", lopsided(100, degree=2))
    second = sog.read(tmp_path)
    as_version_1(tmp_path)
    first = sog.read(tmp_path)
    np.testing.assert_array_equal(first.means, second.means)
    np.testing.assert_array_equal(first.quaternions, second.quaternions)
    assert first.sh.shape == (100, 9, 3)
    assert -4 <= first.opacity_logits.min() < first.opacity_logits.max() <= 4
    splat_transform(tmp_path / "meta.json", tmp_path / "other.ply")
    assert_within(
        first, read_plainly(tmp_path / "other.ply"), **SAME | dict.fromkeys(("log_scales", "sh0", "sh"), 1e-6)
    )


def test_codebooks() -> None:
    rng = np.random.default_rng(0)
    few = np.float32([3, 1, 2, 2])
    np.testing.assert_array_equal(codebook(few)[:4], [1, 2, 3, 3])
    values = np.concatenate([rng.standard_normal(200_000), [30.0]]).astype(np.float32)
    entries = codebook(values)
    assert len(entries) == 256 and (np.diff(entries) >= 0).all()
    error = np.square(values - entries[nearest(entries, values)]).mean()
    # Panter and Dite's best for a normal distribution is sqrt(3) pi / 2 / 256^2; an even spread to 30 has 6 times that
    assert error < 1.15 * 3**0.5 * np.pi / 2 / 256**2


def test_palettes() -> None:
    rng = np.random.default_rng(0)
    centres = rng.standard_normal((64, 9)).astype(np.float32)
    vectors = centres[rng.integers(0, 64, 4000)] + rng.standard_normal((4000, 9)).astype(np.float32) * 0.01
    entries, labels = palette(vectors, 512)
    assert entries.shape == (512, 9)
    assert np.sqrt(np.square(vectors - entries[labels]).mean()) < 0.011  # the clusters are found, and not more
    again = palette(vectors, 512)
    np.testing.assert_array_equal(again[0], entries)
    one, label = palette(np.zeros((5, 3), np.float32), 4)
    assert not one.any() and not one[label].any()


def test_a_palette_far_from_zero_is_as_good() -> None:
    """Squared distances of numbers around 50 have no digits left in float32."""
    vectors = np.random.default_rng(5).normal(0, 0.01, (3000, 9)).astype(np.float32)
    errors = []
    for offset in (0, 50):
        moved = vectors + np.float32(offset)
        entries, labels = palette(moved, 1024)
        errors.append(np.square(moved - entries[labels]).mean())
    assert errors[1] < 1.5 * errors[0]


def test_writing_tells_how_far_it_is(tmp_path: Path) -> None:
    told: list[tuple[str, float | None]] = []
    sog.write(tmp_path / "a.sog", lopsided(300), progress=lambda stage, part: told.append((stage, part)))
    parts = [part for _, part in told]
    assert {stage for stage, _ in told} == {"SOG: choosing 256 sets of SH coefficients for 300 Gaussians"}
    assert parts[0] == 0 and parts == sorted(parts) and len(parts) > 8 and 0.5 < parts[-1] <= 1


def test_damaged_files(tmp_path: Path) -> None:
    path = tmp_path / "model.sog"
    sog.write(path, lopsided(8, degree=1))
    assert (
        refused_of(sog.read, path, step=path.stat().st_size // 100) > 150
    )  # every cut, and most changes: zip has sums


def change(folder: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    meta = json.loads((folder / "meta.json").read_text())
    edit(meta)
    (folder / "meta.json").write_text(json.dumps(meta))


def meta_of(folder: Path, count: int, degree: int) -> Path:
    """The meta.json of such a model, in this folder."""
    sog.write(folder / "meta.json", lopsided(count, degree=degree))
    return folder / "meta.json"


LIES: dict[str, Callable[[dict[str, Any]], object]] = {
    "version": lambda meta: meta.update(version=3),
    "count": lambda meta: meta.update(count=1 << 30),
    "no count": lambda meta: meta.update(count="many"),
    "no means": lambda meta: meta.pop("means"),
    "no scales": lambda meta: meta.pop("scales"),
    "mins": lambda meta: meta["means"].update(mins=[1, 2]),
    "infinite": lambda meta: meta["means"].update(maxs=[1e300, 1, 1]),
    "too far": lambda meta: meta["means"].update(maxs=[90, 1, 1]),
    "short codebook": lambda meta: meta["scales"].update(codebook=[1.0]),
    "no codebook": lambda meta: meta["sh0"].update(codebook="x"),
    "no files": lambda meta: meta["quats"].update(files=[]),
    "missing": lambda meta: meta["quats"].update(files=["missing.webp"]),
    "outside": lambda meta: meta["quats"].update(files=["../quats.webp"]),
    "absolute": lambda meta: meta["quats"].update(files=["/etc/hostname"]),
    "zero byte": lambda meta: meta["quats"].update(files=["\0"]),
    "not a picture": lambda meta: meta["quats"].update(files=["meta.json"]),
    "three channels": lambda meta: meta["quats"].update(files=["scales.webp"]),
    "bands": lambda meta: meta["shN"].update(bands=3),
    "palette": lambda meta: meta["shN"].update(files=["shN_labels.webp", "shN_centroids.webp"]),
}


@pytest.mark.parametrize("lie", LIES)
def test_lies(tmp_path: Path, lie: str) -> None:
    folder = tmp_path / "model"
    folder.mkdir()
    sog.write(folder / "meta.json", lopsided(20, degree=1))
    (tmp_path / "quats.webp").write_bytes((folder / "quats.webp").read_bytes())
    change(folder, LIES[lie])
    assert assert_refused_or_sound(sog.read, folder / "meta.json")


def test_a_count_that_is_too_large_is_named_with_what_fits(tmp_path: Path) -> None:
    path = meta_of(tmp_path, 20, degree=1)
    for count, shown in ((10**12, "1000000000000"), (1 << 32, "4294967296"), (0, "0"), (-3, "-3")):
        change(tmp_path, lambda meta, count=count: meta.update(count=count))
        refuses(rf"meta\.json: has {shown} Gaussians, expected 1 to 4294967295$", sog.read, path)


@pytest.mark.parametrize("kind", ["empty", "text", "cut", "head", "changed", "PNG"])
def test_a_picture_that_does_not_decode_has_its_own_name(kind: str, tmp_path: Path) -> None:
    """The decoder's words too name it as the archive does, not by the file that it was unpacked to."""
    good, bad = tmp_path / "good.sog", tmp_path / "bad.sog"
    sog.write(good, lopsided(50, degree=1))
    with zipfile.ZipFile(good) as source, zipfile.ZipFile(bad, "w") as target:
        for name in source.namelist():
            data = source.read(name)
            wrong = {
                "empty": b"", "text": b"x" * 100, "cut": data[: len(data) // 2], "head": data[:20],
                "changed": data[:30] + bytes([data[30] ^ 255]) + data[31:], "PNG": b"\x89PNG\r\n\x1a\n" + bytes(50),
            }[kind]  # fmt: skip
            target.writestr(name, wrong if name == "quats.webp" else data)
    said = complaint(bad, sog.read, bad)
    assert said.startswith("quats.webp: does not decode: ") and "/" not in said and "file.webp" not in said


def test_one_number_is_called_so(tmp_path: Path) -> None:
    sog.write(tmp_path / "meta.json", lopsided(100, degree=2))
    as_version_1(tmp_path)
    for given, said in (
        (["x"], "mins of shN in meta.json is not a list of numbers, expected a finite number"),
        ([1, 2], "mins of shN in meta.json has 2 numbers, expected 1"),
    ):
        change(tmp_path, lambda meta, given=given: meta["shN"].update(mins=given))
        refuses(rf": {re.escape(said)}$", sog.read, tmp_path / "meta.json")


@pytest.mark.brings("splat-transform", "SOG with null in codebooks", "a scale of 0, or left out")
def test_null_is_what_json_has_no_number_for(tmp_path: Path) -> None:
    """splat-transform writes it for -inf, the log of a scale of 0, and for NaN."""
    path, model = tmp_path / "meta.json", lopsided(300, degree=1)
    sog.write(path, model)
    plain = formats.load(path)
    meta = json.loads(path.read_text())
    code = int(np.abs(np.array(meta["scales"]["codebook"]) - plain.log_scales[5, 2]).argmin())
    change(tmp_path, lambda meta: meta["scales"]["codebook"].__setitem__(code, None))
    flat = plain.log_scales == plain.log_scales[5, 2]
    users = flat.any(axis=1).sum()
    assert users < 30
    read = warned(f"null in place of 1 of 256 numbers, which give {users} of 300 Gaussians", formats.load, path)
    wanted = np.where(flat, np.float32(np.log(packing.MIN_SCALE)), plain.log_scales)
    np.testing.assert_array_equal(read.log_scales, wanted)
    colour = int(np.abs(np.array(meta["sh0"]["codebook"]) - plain.sh[7, 0, 1]).argmin())
    change(tmp_path, lambda meta: meta["sh0"]["codebook"].__setitem__(colour, None))
    gone = (plain.sh[:, 0] == plain.sh[7, 0, 1]).any(axis=1)
    with pytest.warns(UserWarning, match=rf"{gone.sum()} of 300 .* first is a colour of Gaussian {gone.argmax()}"):
        np.testing.assert_array_equal(formats.load(path).means, plain.means[~gone])


def test_null_in_the_ranges_of_version_1(tmp_path: Path) -> None:
    """A least scale of -inf: step 0 is a scale of 0; step 255 the largest."""
    sog.write(tmp_path / "meta.json", lopsided(100, degree=2))
    meta = as_version_1(tmp_path)
    plain = formats.load(tmp_path)
    change(tmp_path, lambda meta: meta["scales"]["mins"].__setitem__(0, None))
    read = formats.load(tmp_path)
    top = np.float32(meta["scales"]["maxs"][0])
    wanted = np.where(plain.log_scales[:, 0] == top, top, np.float32(np.log(packing.MIN_SCALE)))
    np.testing.assert_array_equal(read.log_scales[:, 0], wanted)
    np.testing.assert_array_equal(read.log_scales[:, 1:], plain.log_scales[:, 1:])


NULLS: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "all": (
        lambda meta: meta["scales"].update(codebook=[None] * 256),
        r"codebook of scales in meta\.json has nothing but null in place of numbers",
    ),
    "none": (
        lambda meta: meta["sh0"].update(codebook=[]),
        r"codebook of sh0 in meta\.json has 0 numbers, expected 1 to 256",
    ),
    "of means": (
        lambda meta: meta["means"].update(mins=[0, None, 1]),
        r"mins of means in meta\.json has null in place of numbers",
    ),
    "missing": (lambda meta: meta["scales"].pop("codebook"), r"scales in meta\.json has no codebook"),
    "words": (
        lambda meta: meta["shN"].update(codebook=["x", None]),
        r"codebook of shN in meta\.json is not a list of numbers, expected 1 to 256 finite numbers",
    ),
    "too many": (
        lambda meta: meta["means"].update(maxs=[1.0] * 4),
        r"maxs of means in meta\.json has 4 numbers, expected 3",
    ),
}


@pytest.mark.parametrize("name", NULLS)
def test_no_numbers(tmp_path: Path, name: str) -> None:
    path, (edit, message) = tmp_path / "meta.json", NULLS[name]
    sog.write(path, lopsided(20, degree=1))
    change(tmp_path, edit)
    refuses(message, formats.load, path)


@links
def test_a_picture_that_is_a_link_to_itself(tmp_path: Path) -> None:
    path = meta_of(tmp_path, 20, degree=0)
    (tmp_path / "quats.webp").unlink()
    (tmp_path / "quats.webp").symlink_to("quats.webp")
    refuses(r"its picture quats\.webp is missing", sog.read, path)
    assert size(path, format_of(path)) > 0


def test_an_archive_cannot_unpack_to_more_than_its_gaussians(tmp_path: Path) -> None:
    path, bomb = tmp_path / "model.sog", tmp_path / "bomb.sog"
    sog.write(path, lopsided(20, degree=0))
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as target:
        for name in source.namelist():
            target.writestr(name, bytes(64 << 20) if name == "quats.webp" else source.read(name))
    said = r"bomb\.sog: quats\.webp has more than \d+ bytes unpacked"
    assert peak_of(lambda: refuses(said, sog.read, bomb)) < 8 << 20
    path.write_bytes(b"PK\3\4 and nothing more")
    refuses(r"model\.sog: is not a \.sog archive", sog.read, path)


def test_null_at_the_head_of_a_codebook_is_a_scale_of_0(tmp_path: Path) -> None:
    """As splat-transform, which sorts it, writes flat Gaussians: no word. Among the numbers it is told."""
    sog.write(tmp_path / "meta.json", lopsided(300, degree=0))
    change(tmp_path, lambda meta: meta["scales"]["codebook"].__setitem__(slice(0, 2), [None, None]))
    with no_warnings():
        formats.load(tmp_path / "meta.json")
    change(tmp_path, lambda meta: meta["scales"]["codebook"].__setitem__(-1, None))
    warned("has null in place of 3 of 256 numbers, which", formats.load, tmp_path / "meta.json")


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"version": "2"}, r'SOG version "2" in meta\.json, expected the number 1 or 2$'),
        ({"version": 3}, r"SOG version 3 in meta\.json, expected the number 1 or 2$"),
        ({"count": None}, r"meta\.json has the count null, expected the number of Gaussians, a whole number$"),
        ({"count": 20.0}, r"meta\.json has the count 20\.0, expected the number of Gaussians"),
        ({"count": "20"}, r'meta\.json has the count "20", expected the number of Gaussians'),
    ],
)
def test_what_is_wrong_is_told_as_it_is(tmp_path: Path, keys: dict[str, Any], message: str) -> None:
    path = meta_of(tmp_path, 20, degree=0)
    change(tmp_path, lambda meta: meta.update(keys))
    refuses(message, sog.read, path)
    change(tmp_path, lambda meta: [meta.pop("count"), meta.update(version=2)])
    refuses(r"meta\.json has no count, expected the number of Gaussians", sog.read, path)


def test_null_in_place_of_the_coefficients_is_none(tmp_path: Path) -> None:
    path = meta_of(tmp_path, 20, degree=0)
    wanted = sog.read(path)
    change(tmp_path, lambda meta: meta.update(shN=None))
    assert_equal(sog.read(path), wanted)


@pytest.mark.brings("Windows, macOS", "SOG whose pictures' names are of another case", "found")
@pytest.mark.parametrize("archived", [False, True])
def test_names_of_another_case(tmp_path: Path, archived: bool) -> None:
    path = meta_of(tmp_path, 20, degree=1)
    wanted = sog.read(path)
    change(tmp_path, lambda meta: meta["means"].update(files=["MEANS_L.webp", "Means_U.WEBP"]))
    if archived:
        with zipfile.ZipFile(tmp_path / "model.sog", "w") as archive:
            for file in [path, *tmp_path.glob("*.webp")]:
                archive.write(file, file.name)
        path = tmp_path / "model.sog"
    assert_equal(sog.read(path), wanted)
    change(tmp_path, lambda meta: meta["means"].update(files=["means.webp", "Means_U.WEBP"]))
    refuses(r"its picture means\.webp is missing", sog.read, tmp_path / "meta.json")
