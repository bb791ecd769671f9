# SPDX-License-Identifier: Apache-2.0
"""Lenses that bend: STMaps and photographs' lenses against closed forms, pycolmap and photographs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import scenes
from calls import Capture, error_line, fails, ran, rejected
from pictures import write_pixels
from rendered import camera_file
from scipy import ndimage
from tiny import hidden_model

from clsplat.camera import Camera
from clsplat.cli.main import main
from clsplat.device.context import Device
from clsplat.frame.lens import ByLens, ByMap, Warp, distorted_places, undistorted_places
from clsplat.frame.pipeline import FramePipeline, FrameRequest
from clsplat.frame.strips import in_strips
from clsplat.frame.warp import cubic, nearest, warped
from clsplat.images.stmap import StMap, read_stmap, write_stmap
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.dataset import Lens, undistort

WIDTH, HEIGHT = 96, 64
LINEAR = "--model-colorspace lin_rec709 --colorspace lin_rec709"
"""So that filters see what is blended, and no curve's rounding."""
LENS = Lens("OPENCV", WIDTH, HEIGHT, (90.0, 88.0, 47.0, 33.0, -0.25, 0.08, 0.004, -0.003))
BARREL = Lens("SIMPLE_RADIAL", 120, 80, (100.0, 60.0, 40.0, -0.2))


@pytest.fixture(scope="module")
def shot(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("shot")
    hidden_model().save(folder / "model.ply")
    cameras = camera_file(folder / "cameras.json", {1: 0}, size=(WIDTH, HEIGHT), fov_x=30)
    return [str(folder / "model.ply"), "--cameras", str(cameras)]


@pytest.fixture(scope="module")
def photographed(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[str], np.ndarray]:
    """Arguments of render for a model of small Gaussians, and where the photograph's lens shows them, in pixels, by
    pycolmap."""
    folder = tmp_path_factory.mktemp("photographed")
    x, y = np.meshgrid(np.linspace(6, WIDTH - 6, 5), np.linspace(6, HEIGHT - 6, 4))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    depth = 3 + 0.1 * np.arange(len(pixels))[:, None]
    points = depth * np.concatenate([LENS.cam_from_img(pixels), np.ones((len(pixels), 1))], axis=1)
    size = (len(points), 1)
    scales = np.log(np.tile(0.03, (len(points), 3)))
    turns = np.tile([1.0, 0, 0, 0], size)
    gaussians = scenes.make_gaussians(points, turns, scales, np.full(len(points), 0.9), np.full((*size, 3), 1.5))
    gaussians.save(folder / "model.ply")
    (folder / "cameras.txt").write_text(f"1 {LENS.model} {WIDTH} {HEIGHT} {' '.join(map(str, LENS.params))}\n")
    (folder / "images.txt").write_text("1 1 0 0 0 0 0 0 1 photo.png\n\n")
    return [str(folder / "model.ply"), "--cameras", str(folder)], LENS.img_from_cam(points)


def render(shot: list[str], path: Path, flags: str = "") -> int:
    return main(["render", *shot, "-o", str(path), "--progress", "none", *flags.split()])


def picture(shot: list[str], path: Path, flags: str = "") -> np.ndarray:
    assert render(shot, path, f"{LINEAR} {flags}") == 0
    return np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT))


def grid(width: int, height: int) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=2)


def centroid(pixels: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Place of the light's middle within four pixels, x and y."""
    first = np.floor(middle).astype(int) - 4
    box = pixels[first[1] : first[1] + 9, first[0] : first[0] + 9, 0].astype(np.float64)
    y, x = np.indices(box.shape) + 0.5
    return first + np.array([(box * x).sum(), (box * y).sum()]) / box.sum()


def test_the_identity_changes_nothing(shot: list[str], tmp_path: Path) -> None:
    write_stmap(tmp_path / "same.exr", grid(WIDTH, HEIGHT), WIDTH, HEIGHT)
    flags = "--channels rgb,alpha,depth,normals,count,id"
    plain = picture(shot, tmp_path / "plain.exr", flags)
    same = picture(shot, tmp_path / "bent.exr", f"{flags} --stmap {tmp_path}/same.exr")
    # a float32 places a pixel to 1e-7 of the width, 1e-5 pixels; values change by less than 1 a pixel
    np.testing.assert_allclose(same[:, :, :4], plain[:, :, :4], atol=1e-5)
    np.testing.assert_array_equal(same[:, :, 4:], plain[:, :, 4:])


def test_a_shift_looks_beyond_the_frame(shot: list[str], tmp_path: Path) -> None:
    write_stmap(tmp_path / "shift.exr", grid(WIDTH, HEIGHT) + np.array([-9, 6]), WIDTH, HEIGHT)
    around = picture(shot, tmp_path / "around.exr", "--channels rgb,alpha,depth --overscan 9")
    bent = picture(shot, tmp_path / "bent.exr", f"--channels rgb,alpha,depth --stmap {tmp_path}/shift.exr")
    assert around[:, :9].any()
    wanted = around[9 + 6 : 9 + 6 + HEIGHT, :WIDTH]
    np.testing.assert_allclose(bent[:, :, :4], wanted[:, :, :4], atol=1e-5)
    # 9 pixels are less than the Jacobian's clamp, so that the overscanned frame's are the same
    np.testing.assert_array_equal(bent[:, :, 4], wanted[:, :, 4])


def test_a_render_falls_on_the_photograph(photographed: tuple[list[str], np.ndarray], tmp_path: Path) -> None:
    shot, places = photographed
    straight = picture(shot, tmp_path / "straight.exr")
    bent = picture(shot, tmp_path / "bent.exr", "--distort")
    assert bent.shape[:2] == (HEIGHT, WIDTH)
    assert straight.shape != bent.shape
    off = [np.linalg.norm(centroid(bent, place) - place) for place in places]
    assert max(off) < 0.05  # pixels
    # twice as large, and of its upper left quarter
    twice = picture(shot, tmp_path / "twice.exr", "--distort --scale 2")
    quarter = picture(shot, tmp_path / "quarter.exr", f"--distort --region 0,0,{WIDTH // 2},{HEIGHT // 2}")
    assert twice.shape[:2] == (2 * HEIGHT, 2 * WIDTH)
    assert max(np.linalg.norm(centroid(twice, 2 * place) - 2 * place) for place in places) < 0.1
    np.testing.assert_array_equal(quarter, bent[: HEIGHT // 2, : WIDTH // 2])


def test_the_maps_that_are_written_do_the_same(photographed: tuple[list[str], np.ndarray], tmp_path: Path) -> None:
    """A render of the undistorted camera, bent by the distorting map, is the photograph's again."""
    shot, places = photographed
    assert main(["stmaps", shot[2], "-o", str(tmp_path / "maps")]) == 0
    assert sorted(path.name for path in (tmp_path / "maps").iterdir()) == ["lens-1.distort.exr", "lens-1.undistort.exr"]
    bent = picture(shot, tmp_path / "bent.exr", f"--stmap {tmp_path}/maps/lens-1.distort.exr")
    assert bent.shape[:2] == (HEIGHT, WIDTH)
    assert max(np.linalg.norm(centroid(bent, place) - place) for place in places) < 0.05
    # and the undistorted picture's pixels are those of the lens, which pycolmap says
    straight = LENS.pinhole(np.eye(3), np.zeros(3))
    back = read_stmap(tmp_path / "maps" / "lens-1.undistort.exr")
    assert (back.width, back.height) == (straight.width, straight.height)
    u, v = back.values[10, 20].astype(np.float64)
    ray = [(20.5 - straight.cx) / straight.fx, (10.5 - straight.cy) / straight.fy, 1.0]
    np.testing.assert_allclose([u * WIDTH, (1 - v) * HEIGHT], LENS.img_from_cam(np.array([ray]))[0], atol=1e-4)


def test_a_photograph_there_and_back(tmp_path: Path) -> None:
    """Undistorted as scenes are, and distorted by the map: the photograph, but for what two interpolations lose."""
    rng = np.random.default_rng(4)
    noise = rng.uniform(0, 1, (BARREL.height, BARREL.width, 3))
    photo = ndimage.gaussian_filter(noise, (2, 2, 0)).astype(np.float32)
    photo = (photo - photo.min()) / np.ptp(photo)
    straight = BARREL.pinhole(np.eye(3), np.zeros(3))
    flat = undistort(photo, BARREL, straight)
    write_stmap(tmp_path / "map.exr", distorted_places(BARREL, straight), straight.width, straight.height)
    places = ByMap(read_stmap(tmp_path / "map.exr")).places(straight, *(np.arange(side) + 0.5 for side in (120, 80)))
    inside = ((places > 2) & (places < [straight.width - 2, straight.height - 2])).all(axis=2)
    assert inside.mean() > 0.7
    again = cubic(flat, places)
    # Catmull and Rom's cubic of a picture blurred by 2 pixels is off by about 1 % of its range at worst
    assert np.abs(again - photo)[inside].max() < 0.02
    assert np.sqrt(np.mean((again - photo)[inside] ** 2)) < 0.003
    # a picture that is not bent back is far off
    assert np.abs(flat[:60, :90] - photo[:60, :90]).max() > 0.2
    # the two maps are each other's inverse: to what a linear step between places is off by
    there = undistorted_places(BARREL, straight)
    back = cubic(places.astype(np.float32), there)
    shown = ((there > 3) & (there < [117, 77])).all(axis=2)
    np.testing.assert_allclose(back[shown], grid(straight.width, straight.height)[shown], atol=1e-3)


def test_what_gets_smaller_is_filtered() -> None:
    """A pattern of single pixels at a third of its size: its mean, not some of its pixels."""
    values = np.zeros((33, 33, 2), np.float32)
    frame = Camera(99, 99, 100.0, 100.0, 49.5, 49.5, np.eye(3), np.zeros(3))
    places = 3 * grid(33, 33)
    values[:, :, 0], values[:, :, 1] = places[:, :, 0] / 99, 1 - places[:, :, 1] / 99
    stmap = map_of(values)
    warp = Warp(ByMap(stmap), frame)
    assert warp.samples == 3

    def stripes(camera: Camera, names: object) -> dict[str, np.ndarray]:
        assert camera.window is not None
        x = camera.window.x + np.arange(camera.width)
        line = (x % 3 == 0).astype(np.float32)
        return {
            "alpha": np.broadcast_to(line, (camera.height, camera.width)),
            "depth": np.tile(line, (camera.height, 1)),
        }

    bent = warped(stripes, warp)(warp.shown, ("alpha", "depth"))
    np.testing.assert_allclose(bent["alpha"], 1 / 3, atol=1e-5)  # float32's places
    assert set(np.unique(bent["depth"])) <= {0.0, 1.0}  # of one pixel, no mean


def map_of(values: np.ndarray) -> StMap:
    return StMap(values, 0, 0, values.shape[1], values.shape[0], "")


def test_where_nothing_is() -> None:
    values = np.full((4, 6, 2), 0.5, np.float32)
    values[0, 0], values[1, 1] = np.nan, 50.0
    frame = Camera(6, 4, 5.0, 5.0, 3.0, 2.0, np.eye(3), np.zeros(3))
    warp = Warp(ByMap(map_of(values)), frame)
    planes = {"alpha": np.ones((9, 9), np.float32), "id": np.full((9, 9), 7)}
    bent = warped(lambda camera, names: planes, warp)(warp.shown, ("alpha", "id"))
    assert bent["alpha"][0, 0] == bent["alpha"][1, 1] == 0
    assert bent["id"][0, 0] == bent["id"][1, 1] == -1
    assert bent["alpha"][3, 5] == 1
    assert bent["id"][3, 5] == 7
    assert warp.empty > 0


def test_strips_have_the_pixels_of_the_whole(default_device: Device) -> None:
    gaussians, camera = scenes.random_cloud(300, 3, WIDTH, HEIGHT)
    camera = replace(camera, fx=90.0, fy=88.0, cx=47.0, cy=33.0)
    names = ("rgb", "alpha", "depth", "id")
    draw, _ = FramePipeline(Renderer(default_device), gaussians).draw(FrameRequest(lambda _: camera, lens=ByLens(LENS)))
    whole, parts = draw(camera, names), in_strips(draw, 16)(camera, names)
    assert whole["alpha"].max() > 0.5
    for name in names:
        np.testing.assert_array_equal(parts[name], whole[name], err_msg=name)


def test_interpolation() -> None:
    rng = np.random.default_rng(0)
    plane = rng.uniform(0, 1, (8, 9, 2)).astype(np.float32)
    np.testing.assert_array_equal(cubic(plane, grid(9, 8)), plane)
    np.testing.assert_array_equal(nearest(plane, grid(9, 8) + 0.49), plane)
    x, y = np.meshgrid(np.arange(9.0), np.arange(8.0))
    ramp = (2 * x - y).astype(np.float32)
    places = rng.uniform([1.5, 1.5], [7.4, 6.4], (5, 6, 2))
    # a cubic that has straight lines as they are; float32's rounding of values up to 16
    np.testing.assert_allclose(cubic(ramp, places), 2 * (places[:, :, 0] - 0.5) - places[:, :, 1] + 0.5, atol=1e-5)
    step = np.zeros((8, 9), np.float32)
    step[:, 4:] = 1
    some = cubic(step, places)
    assert some.min() >= 0
    assert some.max() <= 1


def test_a_lens_in_another_size() -> None:
    frame = LENS.bare(np.eye(3), np.zeros(3))
    x, y = np.array([3.0, 50.0, 90.0]), np.array([10.0, 60.0])
    plain = ByLens(LENS).places(frame, x, y)
    twice = ByLens(LENS).places(frame.resized(2 * WIDTH, 2 * HEIGHT), 2 * x, 2 * y)
    np.testing.assert_allclose(twice, 2 * plain, atol=1e-9)
    rays = np.concatenate([(plain - [frame.cx, frame.cy]) / [frame.fx, frame.fy], np.ones((2, 3, 1))], axis=2)
    back = LENS.img_from_cam(rays.reshape(-1, 3)).reshape(2, 3, 2)
    np.testing.assert_allclose(back, np.stack(np.meshgrid(x, y), axis=2), atol=1e-6)


def test_a_deep_frame_by_a_map(shot: list[str], tmp_path: Path) -> None:
    """By whole pixels no filter has a say: the map moves the deep picture as it does the flat one."""
    write_stmap(tmp_path / "map.exr", np.add(grid(WIDTH, HEIGHT), (5, -3)), WIDTH, HEIGHT)
    flags = f"--stmap {tmp_path}/map.exr {LINEAR}"
    assert render(shot, tmp_path / "flat.exr", f"{flags} --alpha") == 0
    assert render(shot, tmp_path / "deep.exr", f"{flags} --deep") == 0
    flat = oiio.ImageBuf(str(tmp_path / "flat.exr")).get_pixels(oiio.FLOAT)
    deep = oiio.ImageBufAlgo.flatten(oiio.ImageBuf(str(tmp_path / "deep.exr"))).get_pixels(oiio.FLOAT)
    assert flat[:, :, 3].max() > 0.5
    # float32 places of the map are 1e-5 pixels off, and filters then take as much from the next pixel
    np.testing.assert_allclose(deep[:, :, :4], flat, atol=5e-5)


def test_skip_existing_goes_by_the_map(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    write_stmap(tmp_path / "a.exr", grid(WIDTH, HEIGHT), WIDTH, HEIGHT)
    (tmp_path / "b.exr").write_bytes((tmp_path / "a.exr").read_bytes())
    plan = ran(capsys, render, shot, tmp_path / "frame.exr", f"--stmap {tmp_path}/a.exr --dry-run").out
    assert f"{WIDTH}x{HEIGHT}" in plan
    assert render(shot, tmp_path / "frame.exr", f"--stmap {tmp_path}/a.exr") == 0
    stamp = (tmp_path / "frame.exr").stat().st_mtime_ns
    assert render(shot, tmp_path / "frame.exr", f"--stmap {tmp_path}/b.exr --skip-existing") == 0
    assert (tmp_path / "frame.exr").stat().st_mtime_ns == stamp
    write_stmap(tmp_path / "b.exr", grid(WIDTH, HEIGHT) + 1, WIDTH, HEIGHT)
    capsys.readouterr()
    assert render(shot, tmp_path / "frame.exr", f"--stmap {tmp_path}/b.exr --skip-existing") == 0
    assert "with other cameras or settings" in capsys.readouterr().err
    assert (tmp_path / "frame.exr").stat().st_mtime_ns != stamp


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--stmap none.exr", "none.exr: no such image file"),
        ("--stmap GIVEN --distort", "--stmap and --distort exclude each other"),
        ("--stmap GIVEN --overscan 4", "covers 96x64 pixels from 0,0 on, expected all of the picture"),
        ("--stmap GIVEN --channels motion", "--stmap: motion is not defined for distorted pictures"),
        ("--stmap WHOLE", "WHOLE: has R, G, B as uint8, expected an STMap's R and G as floats"),
        ("--distort", "XMP files, a COLMAP model's folder or a transforms.json"),
        ("--distort --stereo 0.1", "--stereo and --distort exclude each other"),
        ("--distort --path turntable", "--distort: applies to the photographs' own cameras, expected it without"),
    ],
)
def test_errors_are_one_line(shot: list[str], tmp_path: Path, capsys: Capture, flags: str, message: str) -> None:
    write_stmap(tmp_path / "map.exr", grid(WIDTH, HEIGHT), WIDTH, HEIGHT)
    write_pixels(tmp_path / "whole.png", np.zeros((4, 4, 3), np.uint8))
    paths = {"GIVEN": str(tmp_path / "map.exr"), "WHOLE": str(tmp_path / "whole.png")}
    for word, path in paths.items():
        flags, message = flags.replace(word, path), message.replace(word, path)
    before = sorted(tmp_path.iterdir())
    assert message in fails(capsys, render, shot, tmp_path / "a.exr", flags)
    assert sorted(tmp_path.iterdir()) == before


def swirl() -> np.ndarray:
    """Places of a map that turns by up to two thirds of a turn, and is nowhere at its edges."""
    middle = np.array([WIDTH / 2, HEIGHT / 2])
    across, down = (grid(WIDTH, HEIGHT) - middle).transpose(2, 0, 1)
    far = np.hypot(across, down)
    angle = 4 * (1 - far / far.max())
    turned = np.stack([across * np.cos(angle) - down * np.sin(angle), across * np.sin(angle) + down * np.cos(angle)], 2)
    turned[far > 0.9 * far.max()] = np.nan
    return np.asarray(turned + middle)


@pytest.mark.parametrize("kind", ["noise", "grey", "one colour", "beauty"])
def test_a_picture_is_no_map(shot: list[str], tmp_path: Path, capsys: Capture, kind: str) -> None:
    values = {
        "noise": np.random.default_rng(1).random((HEIGHT, WIDTH, 2)),
        "grey": np.repeat(grid(WIDTH, HEIGHT)[:, :, :1] / WIDTH, 2, axis=2),
        "one colour": np.full((HEIGHT, WIDTH, 2), (0.25, 0.5)),
        "beauty": picture(shot, tmp_path / "beauty.exr")[:, :, :2],
    }[kind]
    write_stmap(tmp_path / "map.exr", values * (WIDTH, HEIGHT), WIDTH, HEIGHT)
    capsys.readouterr()
    assert render(shot, tmp_path / "a.exr", f"--stmap {tmp_path}/map.exr") == 2
    assert "map.exr: looks like a picture: as an STMap, it would mirror some" in error_line(capsys)


def test_maps_of_any_way_around_are_maps(tmp_path: Path) -> None:
    """Mirrored, on its side, of halves, drawn in by fifty, turned, and without numbers."""
    same = grid(WIDTH, HEIGHT)
    halves = (same / 4096).astype(np.float16).astype(np.float64) * 4096
    turned, mirrored, nowhere = same[::-1, ::-1, ::-1], same[:, ::-1], np.full_like(same, np.nan)
    for index, places in enumerate((same, mirrored, turned, halves, same / 50, swirl(), nowhere)):
        write_stmap(tmp_path / f"{index}.exr", places, WIDTH, HEIGHT)
        assert read_stmap(tmp_path / f"{index}.exr").values.shape == (HEIGHT, WIDTH, 2)


def test_a_map_that_points_nowhere_is_told(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    places = grid(WIDTH, HEIGHT)
    places[:, : WIDTH // 2] = np.nan
    write_stmap(tmp_path / "map.exr", places, WIDTH, HEIGHT)
    assert render(shot, tmp_path / "a.exr", f"--stmap {tmp_path}/map.exr") == 0
    assert "the undistorted picture does not contain what these pixels show" in capsys.readouterr().err
    assert not np.asarray(oiio.ImageBuf(str(tmp_path / "a.exr")).get_pixels(oiio.FLOAT))[:, : WIDTH // 2].any()


def test_stmaps_of_cameras_that_do_not_bend(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} 90 90 48 32\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 photo.png\n\n")
    assert "its lenses have no distortion" in rejected(capsys, ["stmaps", tmp_path, "-o", tmp_path / "maps"])
    assert "has no cameras of photographs with" in rejected(capsys, ["stmaps", shot[2], "-o", tmp_path / "maps"])
    assert not (tmp_path / "maps").exists()
