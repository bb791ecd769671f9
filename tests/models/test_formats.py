# SPDX-License-Identifier: Apache-2.0
"""Every format in turn: a model comes back in its place, with the loss that the format has; bad files are named."""

from __future__ import annotations

import io
import random
import sys
import tracemalloc
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from calls import Capture, printed, refuses, warned
from models import assert_equal, random_gaussians
from needs import SCENES, require
from scipy.spatial.transform import Rotation

import clsplat
from clsplat.camera import Camera
from clsplat.cli.main import main
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.evaluation.metrics import psnr
from clsplat.gaussians import Gaussians
from clsplat.models import difference, edit, formats
from clsplat.models.formats import Format
from clsplat.rendering.renderer import Renderer

WRITTEN = {row.name: row for row in formats.MODEL_FORMATS if row.write}
SIZE = 96


def path_of(row: Format, folder: Path, stem: str = "model") -> Path:
    suffix = next(suffix for suffix in row.suffixes if suffix.startswith("."))
    return folder / (stem + suffix)


def there_and_back(name: str, model: Gaussians, folder: Path) -> Gaussians:
    """The model as it is read from a file of this format."""
    path = path_of(WRITTEN[name], folder)
    formats.save(path, model)
    return formats.load(path)


@cache
def asymmetric() -> Gaussians:
    """Three arms of different length, thickness and colour along x, y and z, each with flat Gaussians turned their own
    way, SH that are different in every direction: it looks like itself from nowhere else, nor in a mirror."""
    rng = np.random.default_rng(5)
    count = 1500
    arm = rng.integers(0, 3, count)
    along = rng.uniform(0.1, 1.0, count) * np.array([2.0, 1.2, 0.7])[arm]
    means = rng.normal(0, 0.05, (count, 3))
    means[np.arange(count), arm] += along
    quaternions = Rotation.random(count, random_state=6).as_quat()[:, [3, 0, 1, 2]] * rng.uniform(0.5, 2, (count, 1))
    log_scales = np.log(rng.uniform(0.01, 0.12, (count, 3)))
    sh = rng.normal(0, 0.12, (count, 16, 3))
    sh[:, 0] = np.array([[1.2, -0.8, -1.2], [-1.0, 1.1, -0.6], [-0.7, -0.3, 1.3]])[arm] + rng.normal(
        0, 0.15, (count, 3)
    )
    logits = rng.normal(0.5, 1.5, count)
    return Gaussians(*(array.astype(np.float32) for array in (means, quaternions, log_scales, logits, sh)))


def cameras() -> list[Camera]:
    """From three sides that no turn by a right angle takes into each other."""
    found = []
    for angles in ((20, 15, 5), (130, -25, 40), (255, 50, -70)):
        rotation = Rotation.from_euler("yxz", angles, degrees=True).as_matrix()
        centre = np.array([0.8, 0.4, 0.2])
        translation = np.array([0.0, 0.0, 4.0]) - rotation @ centre
        found.append(Camera(SIZE, SIZE, 1.5 * SIZE, 1.5 * SIZE, SIZE / 2, SIZE / 2, rotation, translation))
    return found


@pytest.fixture(scope="module")
def renderer(default_device: Device) -> Renderer:
    return Renderer(default_device)


def worst(renderer: Renderer, a: Gaussians, b: Gaussians) -> float:
    """The least PSNR of three views, dB."""
    return min(psnr(renderer.render(a, c).image, renderer.render(b, c).image) for c in cameras())


def as_far_as_it_goes(row: Format, gaussians: Gaussians) -> Gaussians:
    """Without the SH that the format has no place for."""
    return edit.drop_sh(gaussians, row.sh_degree)


def test_any_mirror_or_turn_of_the_axes_would_be_seen(renderer: Renderer) -> None:
    """What the next test says is worth something: each mirror, each exchange of axes is far below its 35 dB, and so is
    SH that was left unturned."""
    whole = asymmetric()
    for axes in ((1, 1, -1), (1, -1, 1), (-1, 1, 1), (1, -1, -1), (-1, -1, 1), (-1, -1, -1)):
        matrix = np.diag([*axes, 1.0])
        assert worst(renderer, whole, edit.transform(whole, matrix)) < 25
        only_sh = edit.take(whole, np.arange(len(whole)))
        only_sh.sh = edit.rotate_sh(whole.sh, np.diag(axes).astype(float))
        assert worst(renderer, whole, only_sh) < 35
    swapped = edit.transform(whole, np.array([[0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]]))
    assert worst(renderer, whole, swapped) < 25


@pytest.mark.parametrize("name", WRITTEN)
def test_a_model_comes_back_in_its_place(name: str, renderer: Renderer, tmp_path: Path) -> None:
    row, path = WRITTEN[name], path_of(WRITTEN[name], tmp_path)
    whole = as_far_as_it_goes(row, asymmetric())
    formats.save(path, whole)
    assert formats.format_of(path) is row
    read = Gaussians.load(path)
    read.check()
    assert len(read) == len(whole)
    assert read.sh_degree == whole.sh_degree
    # the contract: 60 dB for floats, 35 for what is quantised
    assert worst(renderer, whole, read) >= (60 if row.floats else 35)


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("name", WRITTEN)
def test_every_degree_of_sh(name: str, degree: int, tmp_path: Path) -> None:
    model = edit.drop_sh(asymmetric(), degree)
    read = there_and_back(name, model, tmp_path)
    assert read.sh_degree == min(degree, WRITTEN[name].sh_degree)
    assert len(read) == len(model)


@pytest.mark.parametrize("name", WRITTEN)
def test_the_same_model_gives_the_same_bytes(name: str, tmp_path: Path) -> None:
    paths = [path_of(WRITTEN[name], tmp_path / folder) for folder in ("a", "b")]  # a name may be in the file
    for path in paths:
        path.parent.mkdir()
        formats.save(path, edit.take(asymmetric(), np.arange(300)))
    assert paths[0].read_bytes() == paths[1].read_bytes()


@pytest.mark.parametrize("name", WRITTEN)
def test_a_single_gaussian_and_a_point(name: str, tmp_path: Path) -> None:
    """No extent to divide by."""
    one = edit.take(asymmetric(), np.arange(1))
    for model in (one, edit.merge([one, one])):
        read = there_and_back(name, model, tmp_path)
        assert len(read) == len(model)
        np.testing.assert_allclose(read.means, model.means, atol=1e-3)


@pytest.mark.parametrize("name", WRITTEN)
def test_extremes_stay_finite(name: str, tmp_path: Path) -> None:
    """Opacities of 0 and 1, scales of nothing and of a world, colours beyond what a byte holds, no rotation at all."""
    model = random_gaussians(64, 1)
    model.opacity_logits[:4] = (-200, 200, -20, 20)
    model.log_scales[:4] = ((-60, -60, -60), (12, 12, 12), (-60, 0, 0), (5, -5, 0))
    model.sh[:2, 0] = ((40, 40, 40), (-40, -40, -40))
    model.quaternions[3] = 0
    read = there_and_back(name, model, tmp_path)
    read.check()
    assert all(np.isfinite(array).all() for array in read.arrays().values())


@pytest.mark.parametrize("field", ["means", "quaternions", "log_scales", "opacity_logits", "sh"])
@pytest.mark.parametrize("name", WRITTEN)
def test_nothing_is_written_that_no_reader_takes(name: str, field: str, tmp_path: Path) -> None:
    path, model = path_of(WRITTEN[name], tmp_path), random_gaussians(9, 1)
    getattr(model, field)[5] = np.nan
    refuses(f"{path.name}: cannot be written: Gaussian 5 has an? .* not finite", formats.save, path, model)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", WRITTEN)
def test_means_that_count_from_elsewhere_are_written_in_the_world(name: str, tmp_path: Path) -> None:
    model = edit.take(asymmetric(), np.arange(100))
    model.origin = np.array([1000.0, -2000.0, 500.0])
    read = there_and_back(name, model, tmp_path)
    world = read.means + read.origin
    # Whatever order they are in; float32 at 2000 has steps of 1.2e-4, and quantised formats their own
    np.testing.assert_allclose(world.mean(axis=0), model.means.mean(axis=0) + model.origin, atol=2e-2)
    np.testing.assert_allclose(np.sort(world, axis=0), np.sort(model.means + model.origin, axis=0), atol=5e-2)


@pytest.mark.parametrize("name", WRITTEN)
def test_the_loss_is_small_in_every_attribute(name: str, tmp_path: Path) -> None:
    """The error of each attribute that `clsplat convert` prints: nothing in floats, a few steps of a byte else."""
    row = WRITTEN[name]
    whole = as_far_as_it_goes(row, asymmetric())
    written = edit.take(whole, row.order(whole)) if row.order else whole
    found = difference.errors(written, there_and_back(name, whole, tmp_path))
    # Floats: logs and logits of what is stored, and unit quaternions, are rounded once more. Else: positions to 10
    # bits, scales and opacities to 7 or 8, rotations to 8, colour to 8. SH of which every one is different are the
    # worst for a palette: the render has to do, this bound is of four of their standard deviations.
    limits = {
        "position_relative": (1e-6, 2e-3),
        "scale": (2e-6, 0.1),
        "rotation": (1e-3, 2.0),
        "opacity": (1e-6, 0.01),
        "colour": (1e-6, 0.3),
        "sh": (1e-6, 0.5),
    }
    for attribute, (for_floats, else_) in limits.items():
        assert found[attribute]["largest"] <= (for_floats if row.floats else else_), attribute


def test_scales_count_as_a_part_of_the_gaussians_largest(tmp_path: Path) -> None:
    """A disc's thickness that is cut to what a format holds is no loss that could be seen, a wrong diameter is."""
    disc = edit.take(asymmetric(), np.arange(3))
    disc.log_scales[:] = ((-3, -4, -30), (-30, -3, -3), (-3, -3, -3))  # SPZ ends at -10
    formats.save(tmp_path / "a.spz", disc)
    found = difference.errors(disc, formats.load(tmp_path / "a.spz"))["scale"]["largest"]
    assert found == pytest.approx(np.exp(-7), rel=0.01)  # exp(-10) of exp(-3); that of whole sixteenths is 0
    wider = replace(disc, log_scales=disc.log_scales + np.float32([[0, 0, 0], [0, 0, 0.5], [0, 0, 0]]))
    assert difference.errors(disc, wider)["scale"]["largest"] == pytest.approx(np.expm1(0.5), rel=1e-5)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*(they are left out|bytes after|by its content):UserWarning")
@pytest.mark.parametrize("name", WRITTEN)
@pytest.mark.parametrize("way", ["cut", "flip", "zeros", "ones", "empty"])
def test_a_spoilt_file_is_one_line_in_bounded_memory(name: str, way: str, tmp_path: Path) -> None:
    path = path_of(WRITTEN[name], tmp_path)
    formats.save(path, edit.take(asymmetric(), np.arange(200)))
    whole = path.read_bytes()
    rng = random.Random(3)
    for _ in range(1 if way == "empty" else 25):
        data = bytearray(whole)
        at = rng.choice(
            (rng.randrange(len(data)), rng.randrange(min(len(data), 64)), rng.randrange(min(len(data), 999)))
        )
        if way == "cut":
            del data[at:]
        elif way == "empty":
            data = bytearray()
        else:
            values = {"flip": [data[at] ^ 1 << rng.randrange(8)], "zeros": [0] * 8, "ones": [255] * 8}[way]
            data[at : at + len(values)] = bytes(values)
        path.write_bytes(data)
        trouble = ""
        tracemalloc.start()
        try:
            formats.load(path).check()
        except InputError as error:
            trouble = str(error)
        finally:
            _, peak = tracemalloc.get_traced_memory()
            tracemalloc.stop()
        assert trouble == "" or trouble.startswith(str(path.parent)), trouble
        assert "\n" not in trouble
        # 200 Gaussians are 50 kB; tables of a codec and imports of a first call are in it too
        assert peak < 64 << 20


def test_no_such_ending_and_no_such_file(tmp_path: Path) -> None:
    refuses(r"x\.doc: does not have the suffix of a model .*\.ply", formats.save, tmp_path / "x.doc", asymmetric())
    with pytest.raises(InputError, match=r"x\.ksplat: ksplat files cannot be written, expected one of .*\.ply"):
        formats.save(tmp_path / "x.ksplat", asymmetric())
    for name in ("x.ply", "x.doc", "x.splat"):
        refuses(f"{name}: no such file, expected a model file .*ply", formats.load, tmp_path / name)
    (tmp_path / "x.doc").write_bytes(b"words")
    refuses(r"x\.doc: does not have the suffix of a model file", formats.load, tmp_path / "x.doc")


def test_first_bytes_go_before_the_ending(tmp_path: Path) -> None:
    """A compressed PLY is often called .ply; and a file without any ending may still say what it is."""
    model = edit.take(asymmetric(), np.arange(300))
    compressed, plain = tmp_path / "a.compressed.ply", tmp_path / "b.ply"
    formats.save(compressed, model)
    formats.save(plain, model)
    wanted = formats.load(compressed)
    for name in ("c.ply", "c.splat", "c"):
        (tmp_path / name).write_bytes(compressed.read_bytes())
        if name != "c.splat":  # which has no mark to miss
            assert_equal(formats.load(tmp_path / name), wanted)
    (tmp_path / "d.compressed.ply").write_bytes(plain.read_bytes())
    assert_equal(formats.load(tmp_path / "d.compressed.ply"), model)


@pytest.mark.parametrize("suffix", formats.suffixes())
def test_samples_of_other_tools(suffix: str) -> None:
    found = sorted((SCENES / "samples").rglob(f"*{suffix}"))
    if not found:
        require("scenes")
        pytest.skip(f"no sample with the ending {suffix} is there")
    for path in found:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # one of them has bytes after its data
            formats.load(path).check()


def test_the_table_is_sound() -> None:
    endings = formats.suffixes()
    assert len(set(endings)) == len(endings), "an ending of two formats"
    assert all(ending == ending.lower() for ending in endings)
    page = (Path(clsplat.__file__).parents[1] / "docs/formats.md").read_text("utf-8")
    assert [ending for ending in endings if f"`{ending}`" not in page] == []
    for row in formats.MODEL_FORMATS:
        assert "http" in (sys.modules[row.read.__module__].__doc__ or ""), f"{row.name} cites no specification"


def test_a_format_is_one_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    """A row in the table is all that load, save, info and convert want to know a format."""

    def write(path: Path, gaussians: Gaussians) -> None:
        with path.open("wb") as file:
            file.write(b"ours")
            np.savez(file, **gaussians.arrays())

    def read(path: Path) -> Gaussians:
        return Gaussians(**np.load(io.BytesIO(path.read_bytes()[4:])))

    def recognises(head: bytes) -> bool:
        return head.startswith(b"ours")

    row = Format(
        "ours", (".ours",), read, write, recognises, loses="no more than NumPy", describe=lambda _: {"version": 7}
    )
    monkeypatch.setattr(formats, "MODEL_FORMATS", (*formats.MODEL_FORMATS, row))
    model, path = random_gaussians(300), tmp_path / "a.ours"
    model.save(path)
    assert path.read_bytes().startswith(b"ours")
    assert_equal(Gaussians.load(path), model)
    assert ".ours" in formats.suffixes(writable=True)
    said = printed(capsys, ["info", path]).out
    assert "format        ours, version 7\n" in said
    assert "loses         no more than NumPy\n" in said
    assert main(["convert", str(path), str(tmp_path / "b.ply")]) == 0
    assert main(["convert", str(tmp_path / "b.ply"), str(tmp_path / "c.ours")]) == 0
    assert_equal(formats.load(tmp_path / "c.ours"), model)
    assert_equal(warned(r"d\.ply: is ours by its content", formats.load, path.rename(tmp_path / "d.ply")), model)
    refuses(r"expected one of .* \.ours ", formats.save, tmp_path / "x.doc", model)
