# SPDX-License-Identifier: Apache-2.0
"""The town of `clsplat demo --town`: its scene as it is read, and the promises of its options."""

from __future__ import annotations

import json
import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import Capture, error_line
from numpy.typing import NDArray

from clsplat.cli.main import main, parse
from clsplat.cli.train import TrainVerb
from clsplat.config.masks import MaskUse
from clsplat.demo.town import photography, visibility, writing
from clsplat.demo.town.blocks import BLOCK_METRES, BLOCK_REACH_METRES, MAX_HEIGHT_METRES, city_block
from clsplat.demo.town.flights import photographs
from clsplat.demo.town.settings import TownConfig
from clsplat.demo.town.view_rays import world_rays
from clsplat.demo.town.writing import write_town
from clsplat.errors import InputError
from clsplat.images.reading import read_image
from clsplat.scenes.loading import load_scene
from clsplat.scenes.readers import colmap

SMALL = TownConfig(1, 1, photos=7, width=64, height=40)
RIGS = ("perspective", "fisheye", "panorama")
ORIGIN = (500_000.0, 4_650_000.0, 12.5)
NO_POINT = 2**64 - 1
Towns = Callable[[str], Path]


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Towns:
    """Towns by the rig in their streets: far from the origin, with cars and noisy poses. Each is made once."""
    folder = tmp_path_factory.mktemp("towns")

    def made(rig: str) -> Path:
        if not (folder / rig).exists():
            config = replace(SMALL, rig=rig, origin=ORIGIN, cars=3, pose_noise=0.5)  # type: ignore[arg-type]
            write_town(folder / rig, config)
        return folder / rig

    return made


def observations(model: Path) -> dict[str, tuple[NDArray[np.float64], NDArray[np.uint64]]]:
    """Pixels and points of the observations of each image."""
    found = {}
    with (model / "images.bin").open("rb") as file:
        (count,) = struct.unpack("<Q", file.read(8))
        for _ in range(count):
            file.read(64)
            name = b"".join(iter(lambda: file.read(1), b"\0")).decode()
            (length,) = struct.unpack("<Q", file.read(8))
            rows = np.frombuffer(file.read(24 * length), [("pixel", "<f8", 2), ("point", "<u8")])
            found[name] = rows["pixel"], rows["point"]
    return found


def files(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("rig", RIGS)
def test_observations_are_the_points_as_the_readers_cameras_see_them(town: Towns, rig: str) -> None:
    data = colmap.read_model(town(rig) / "sparse/0")
    exact = {image.name: image for image in colmap.read_images(town(rig) / "exact")}
    seen, lengths = observations(town(rig) / "sparse/0"), np.zeros(len(data.points), int)
    assert len(data.points) > 500 and {image.name for image in data.images} == set(seen) == set(exact)
    for name, (pixels, numbers) in seen.items():
        known = numbers != NO_POINT
        rows = numbers[known].astype(int) - 1
        assert len(set(rows)) == len(rows) > 20
        lengths[rows] += 1
        camera = exact[name].lens.camera(exact[name].rotation, exact[name].translation, "native")
        local = data.points[rows] @ camera.rotation.T + camera.translation
        a, b, _ = camera.model.places_of(camera, local)
        projected = np.stack([camera.cx + camera.fx * a, camera.cy + camera.fy * b], axis=1)
        np.testing.assert_allclose(projected, pixels[known], rtol=0, atol=1e-3)
    tracks = colmap.read_tracks(town(rig) / "sparse/0")
    assert lengths.min() == 2 and lengths.sum() == sum(map(len, tracks.by_image.values()))


@pytest.mark.parametrize("rig", RIGS)
def test_a_point_has_the_same_colour_in_its_photographs(town: Towns, rig: str) -> None:
    data, off, apart = colmap.read_model(town(rig) / "sparse/0"), [], []
    for name, (pixels, numbers) in observations(town(rig) / "sparse/0").items():
        picture = read_image(town(rig) / "images" / name)
        known = numbers != NO_POINT
        column, row = np.floor(pixels[known]).astype(int).T
        colours = data.colors[numbers[known].astype(int) - 1]
        off.append(np.abs(picture[row, column, :3] - colours).mean(axis=1))
        apart.append(np.abs(picture[row, column, :3] - np.roll(colours, 1, axis=0)).mean(axis=1))
    assert np.median(np.concatenate(off)) < 0.4 * np.median(np.concatenate(apart))


@pytest.mark.parametrize("rig", RIGS)
def test_rays_of_pixels_project_to_these_pixels(rig: str) -> None:
    config = replace(SMALL, rig=rig)  # type: ignore[arg-type]
    camera = photographs(config, 0, 0)[-1].camera
    planes = world_rays(camera, 0, camera.height, ((0.0, 0.0),))
    rays = np.stack([axis.ravel() for axis in planes], axis=1).astype(np.float64)
    a, b, _ = camera.model.places_of(camera, rays @ camera.rotation.T)
    y, x = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    np.testing.assert_allclose(camera.cx + camera.fx * a, x.ravel(), atol=1e-3)
    np.testing.assert_allclose(camera.cy + camera.fy * b, y.ravel(), atol=1e-3)


@pytest.mark.parametrize("rig", RIGS)
def test_no_surface_is_lost_outside_a_rectangle(rig: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(visibility, "SIGHT_METRES", 70.0)
    camera = photographs(replace(SMALL, rig=rig, width=48, height=30), 0, 0)[-1].camera  # type: ignore[arg-type]
    blocks = visibility.blocks_in_sight(0, camera)
    surfaces = visibility.Caster(camera, blocks).sight(0, camera.height).surfaces
    whole = np.array([0, camera.height, 0, camera.width], np.int32)
    monkeypatch.setattr(visibility, "rectangles", lambda _, low, __: np.tile(whole, (len(low), 1)))
    monkeypatch.setattr(visibility._Rays, "is_open", lambda *_: True)
    every = visibility.blocks_in_sight(0, camera)
    expected = visibility.Caster(camera, every).sight(0, camera.height).surfaces
    names = [
        [(block.i, block.j, face) for block in some for face in range(8 * len(block.solids))]
        for some in (blocks, every)
    ]
    for one, other in zip(surfaces.ravel().tolist(), expected.ravel().tolist(), strict=True):
        assert one == other if min(one, other) < 0 else names[0][one] == names[1][other]


def test_a_block_stays_within_its_bounds() -> None:
    for number in range(16):
        block = city_block(3, number, -number)
        assert block.low[:2].min() > -BLOCK_REACH_METRES and block.low[2] > -1.1
        assert block.high[:2].max() < BLOCK_METRES + BLOCK_REACH_METRES and block.high[2] < MAX_HEIGHT_METRES


def test_a_larger_town_has_the_photographs_of_a_smaller_one(tmp_path: Path) -> None:
    config = replace(SMALL, photos=4, exposure=1.0, cars=1)
    write_town(tmp_path / "small", config)
    write_town(tmp_path / "large", replace(config, columns=2), workers=1)
    small, large = (
        {name: data for name, data in files(tmp_path / part).items() if name.startswith(("images", "masks"))}
        for part in ("small", "large")
    )
    assert len(small) == 8 and len(large) == 16
    assert {name: large[name] for name in small} == small


def test_the_same_call_gives_the_same_bytes_whatever_the_workers(tmp_path: Path) -> None:
    config = replace(SMALL, photos=3, cars=1, exposure=1.0, pose_noise=1.0)
    for name, workers in (("one", 1), ("two", 2)):
        write_town(tmp_path / name, config, workers=workers)
    assert files(tmp_path / "one") == files(tmp_path / "two")


def test_bands_change_no_byte(monkeypatch: pytest.MonkeyPatch) -> None:
    shot = photographs(SMALL, 0, 0)[-1]
    whole = photography.take(SMALL, shot)
    monkeypatch.setattr(photography, "BAND_PIXELS", 64 * 7)
    bands = photography.take(SMALL, shot)
    np.testing.assert_array_equal(whole.pixels, bands.pixels)
    np.testing.assert_array_equal(whole.seen.pixels, bands.seen.pixels)


def test_cars_pass_and_have_masks(town: Towns) -> None:
    scene = load_scene(town("perspective"), masks=MaskUse("ignore"))
    share = [1 - read_image(town("perspective") / "masks" / f"{view.name}.png")[..., 0].mean() for view in scene.views]
    assert 0 < max(share) < 0.5 and not scene.warnings
    shot = photographs(SMALL, 0, 0)[0]
    one, other = (photography._moving_cars(replace(SMALL, cars=2), replace(shot, index=index)) for index in (0, 1))
    assert not np.array_equal(one.solids.centres[0], other.solids.centres[0])


def test_a_mask_covers_all_that_a_car_changes() -> None:
    cars = replace(SMALL, cars=12)
    changed = 0
    for shot in photographs(SMALL, 0, 0)[::2]:
        still, moving = photography.take(SMALL, shot), photography.take(cars, shot)
        assert moving.mask is not None and still.mask is None
        np.testing.assert_array_equal(still.pixels[moving.mask], moving.pixels[moving.mask])
        changed += int((still.pixels != moving.pixels).any(axis=2).sum())
    assert changed > 0


def test_an_origin_and_noise_of_poses_are_written(town: Towns) -> None:
    exact, noisy = (
        {image.name: -image.rotation.T @ image.translation for image in colmap.read_images(town("perspective") / part)}
        for part in ("exact", "sparse/0")
    )
    for shot in photographs(SMALL, 0, 0):
        np.testing.assert_allclose(exact[shot.name], shot.camera.position + ORIGIN, rtol=0, atol=1e-6)
    off = np.array([exact[name] - noisy[name] for name in exact])
    assert 0.2 < off.std() < 1.0
    assert load_scene(town("perspective")).origin.any()


def test_an_exposure_drifts_from_flight_to_flight() -> None:
    config = replace(SMALL, exposure=1.0, photos=20)
    gains: dict[str, list[float]] = {}
    for i in range(3):
        for shot in photographs(config, i, 0):
            gains.setdefault(shot.name.split("/")[1].rpartition("_")[0], []).append(shot.gain)
    flights = [np.log2(gain) for gain in gains.values()]
    assert max(np.abs(flight).max() for flight in flights) <= 1
    assert all(np.ptp(flight) > 0 for flight in flights)
    assert np.ptp([flight.mean() for flight in flights]) > 0.3
    assert {shot.gain for shot in photographs(SMALL, 0, 0)} == {1.0}


def test_an_interrupted_town_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def interrupted(*arguments: object) -> None:
        calls.append(arguments)
        if len(calls) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(writing, "_take_and_write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_town(tmp_path / "town", SMALL, workers=2)
    assert list(tmp_path.iterdir()) == []


DEMO = "import sys; from clsplat.cli.main import main; sys.exit(main(sys.argv[1:]))"


@pytest.mark.skipif(os.name != "posix", reason="sends signals as POSIX has them")
@pytest.mark.parametrize("name", ["SIGINT", pytest.param("SIGKILL", marks=pytest.mark.slow)])
def test_a_call_after_an_interrupted_one_makes_the_whole_town(tmp_path: Path, name: str) -> None:
    words = ["demo", "-o", str(tmp_path / "town"), "--town", "1x1", "--town-photos", "300", "--town-size", "64x40"]
    process = subprocess.Popen([sys.executable, "-c", DEMO, *words], stderr=subprocess.PIPE, text=True)
    while process.poll() is None and len(list(tmp_path.glob(".town*/result/images/*/*.jpg"))) < 3:
        time.sleep(0.02)
    process.send_signal(getattr(signal, name))
    *_, last = process.communicate(timeout=60)[1].splitlines()
    if name == "SIGINT":
        assert process.returncode == 130
        assert last == (
            "clsplat: interrupted before the town was complete: no file of it is left, and the same command starts anew"
        )
    assert [path.name == "town" for path in tmp_path.iterdir()] == [False] * (name == "SIGKILL")
    write_town(tmp_path / "town", SMALL)
    write_town(tmp_path / "alone", SMALL)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["alone", "town"]
    pictures = {path.name: path.read_bytes() for path in (tmp_path / "alone").rglob("*") if path.is_file()}
    assert {path.name: path.read_bytes() for path in (tmp_path / "town").rglob("*") if path.is_file()} == pictures


def test_files_that_came_while_a_town_was_made_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = writing._write_model

    def write_model(*arguments: Any) -> int:
        (tmp_path / "town").mkdir()
        (tmp_path / "town/file").write_text("mine")
        return plain(*arguments)

    monkeypatch.setattr(writing, "_write_model", write_model)
    with pytest.raises(InputError, match="is neither empty nor a town"):
        write_town(tmp_path / "town", replace(SMALL, photos=1, width=16, height=16))
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")] == ["town", "town/file"]


def test_only_a_town_is_replaced_and_only_if_told(tmp_path: Path) -> None:
    tiny = replace(SMALL, photos=1, width=16, height=16)
    (tmp_path / "file").write_text("mine")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/file").write_text("mine")
    for name, told in (("file", "is a file"), ("mine", "is neither empty nor a town")):
        with pytest.raises(InputError, match=told):
            write_town(tmp_path / name, tiny, overwrite=True)
    write_town(tmp_path / "town", tiny)
    with pytest.raises(InputError, match="exists already; name another folder, or give --overwrite"):
        write_town(tmp_path / "town", tiny)
    write_town(tmp_path / "town", replace(tiny, cars=1), overwrite=True)
    assert json.loads((tmp_path / "town/town.json").read_text())["town"]["cars"] == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "mine", "town"]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--town 2", "--town 2: expected two whole numbers, such as 3x2"),
        ("--town 0x2", "--town 0x2: expected 1 to 1000 blocks a side"),
        ("--town 2x1001", "--town 2x1001: expected 1 to 1000 blocks a side"),
        ("--town 1x1 --town-photos 0", "--town-photos 0: expected 1 to 1000 photographs"),
        ("--town 1x1 --town-size 640", "--town-size 640: expected two whole numbers, such as 640x400"),
        ("--town 1x1 --town-size 8x8", "--town-size 8x8: expected 16 to 8192 pixels a side"),
        ("--town 1x1 --town-rig periscope", "--town-rig"),
        ("--town 1x1 --town-exposure 5", "--town-exposure 5.0: expected 0 to 4 stops"),
        ("--town 1x1 --town-exposure nan", "--town-exposure nan: expected 0 to 4 stops"),
        ("--town 1x1 --town-cars 29", "--town-cars 29: expected 0 to 28 cars"),
        ("--town 1x1 --town-origin 1,2", "--town-origin 1,2: expected three numbers"),
        ("--town 1x1 --town-origin 1,2,nan", "--town-origin 1,2,nan: expected numbers up to 1e+08 metres"),
        ("--town 1x1 --town-pose-noise=-1", "--town-pose-noise -1.0: expected 0 to 100 metres"),
        ("--town 1x1 --seed=-1", "--seed -1: expected a whole number of at least 0"),
        ("--town 1x1 --iterations 5", "--iterations: has no effect with --town, which trains nothing"),
        ("--town 1x1 --device cpu", "--device: has no effect with --town, which trains nothing"),
        ("--town-photos 10", "--town-photos: has an effect only with --town, expected --town too, such as --town 2x2"),
        ("--seed 1", "--seed: has an effect only with --town"),
        ("--overwrite", "--overwrite: has an effect only with --town"),
    ],
)
def test_a_wrong_option_is_one_line(flags: str, message: str, tmp_path: Path, capsys: Capture) -> None:
    assert main(["demo", "-o", str(tmp_path / "town"), *flags.split()]) == 2
    assert message in error_line(capsys)
    assert list(tmp_path.iterdir()) == []


def test_the_command_says_how_to_train_the_town(tmp_path: Path, capsys: Capture) -> None:
    flags = "--town 1x1 --town-photos 2 --town-size 32x20 --town-rig fisheye --town-cars 1 --json"
    flags += " --town-exposure 1 --town-pose-noise 0.1"
    assert main(["demo", "-o", str(tmp_path / "town"), *flags.split()]) == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["photographs"] == 2
    assert f"exact cameras in {tmp_path / 'town' / 'exact'}" in told.err
    verb = parse(told.err.strip().partition("next: clsplat ")[2].split())
    assert isinstance(verb, TrainVerb) and verb.scene == tmp_path / "town"
    config = verb.config
    assert (config.sky, config.lenses, config.masks) == (3000, "native", "ignore")
    assert (config.appearance, config.refine_poses) == ("exposure", True)
