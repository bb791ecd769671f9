# SPDX-License-Identifier: Apache-2.0
"""What frames are written as, read back by OpenImageIO."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from calls import refuses
from headers import exr_attributes
from numpy.typing import NDArray
from scenes import tilted_camera

from clsplat.camera import Window
from clsplat.config.channels import FRAME_CHANNELS
from clsplat.config.pictures import Encoding
from clsplat.errors import ClsplatError, InputError
from clsplat.images.frame_files import (
    FrameFileHeader,
    attribute,
    camera_matrices,
    check_format,
    parse_channels,
    write_channels,
)
from clsplat.reference.cameras import pixel_from_world

WIDTH, HEIGHT = 21, 13


def everything() -> dict[str, NDArray[Any]]:
    """A value of its own for each channel; colours beyond 0 and 1, an index that a float32 does not hold."""
    rng = np.random.default_rng(0)
    made: dict[str, NDArray[Any]] = {}
    for name, layer in FRAME_CHANNELS.items():
        shape = (HEIGHT, WIDTH, len(layer.names))
        made[name] = rng.uniform(-1, 3, shape).astype(np.float32)
    made["depth"] = rng.uniform(1e-3, 1e6, (HEIGHT, WIDTH)).astype(np.float32)
    made["alpha"] = rng.uniform(0, 1, (HEIGHT, WIDTH)).astype(np.float32)
    made["count"] = rng.integers(0, 500, (HEIGHT, WIDTH)).astype(np.int32)
    made["id"] = rng.integers(2**24, 2**31 - 1, (HEIGHT, WIDTH)).astype(np.int32)
    made["id"][0, 0] = -1
    return made


def read(path: Path) -> tuple[dict[str, NDArray[Any]], list[Any]]:
    """Every channel of every part, in its own type, and the parts' specifications."""
    source = oiio.ImageInput.open(str(path))
    assert source is not None, oiio.geterror()
    found: dict[str, NDArray[Any]] = {}
    specs = []
    part = 0
    while source.seek_subimage(part, 0):
        spec = source.spec()
        specs.append(spec)
        for index, name in enumerate(spec.channelnames):
            kind = spec.channelformats[index] if spec.channelformats else spec.format
            wanted = oiio.UINT32 if kind == oiio.TypeDesc("uint") else oiio.FLOAT
            found[name] = source.read_image(part, 0, index, index + 1, wanted)[:, :, 0]
        part += 1
    source.close()
    return found, specs


def formats(spec: Any) -> set[str]:
    return {str(kind) for kind in spec.channelformats} or {str(spec.format)}


@pytest.mark.parametrize("parts", ["one", "several"])
@pytest.mark.parametrize("depth", ["half", "float"])
def test_exr(parts: Any, depth: Any, tmp_path: Path) -> None:
    layers, path = everything(), tmp_path / "a.exr"
    if parts == "one":
        with pytest.raises(InputError, match="which a float cannot hold exactly; use --parts several"):
            write_channels(path, layers, Encoding(depth=depth, parts=parts))
        layers["id"] %= 2**24
    write_channels(path, layers, Encoding(depth=depth, parts=parts))
    found, specs = read(path)
    assert [name for spec in specs for name in spec.channelnames].count("R") == 1
    assert len(specs) == (1 if parts == "one" else 10)
    for name, layer in FRAME_CHANNELS.items():
        planes = layers[name].reshape(HEIGHT, WIDTH, -1)
        for index, channel in enumerate(layer.names):
            wanted = planes[:, :, index]
            if layer.kind == "whole" and parts == "several":
                wanted = wanted.astype(np.int64) % 2**32
            elif layer.kind == "colour" and depth == "half":
                wanted = wanted.astype(np.float16)
            np.testing.assert_array_equal(found[channel], wanted.astype(found[channel].dtype), err_msg=channel)
    assert list(tmp_path.iterdir()) == [path]


def test_parts_have_names_and_formats(tmp_path: Path) -> None:
    write_channels(tmp_path / "a.exr", everything(), Encoding("half", parts="several"))
    _, specs = read(tmp_path / "a.exr")
    names = [spec.get_string_attribute("oiio:subimagename") for spec in specs]
    assert names == ["rgba", "depth", "median", "first", "N", "P", "forward", "backward", "count", "id"]
    assert specs[0].channelnames == ("R", "G", "B", "A")
    assert formats(specs[0]) == {"half"}
    assert formats(specs[1]) == {"float"}
    assert formats(specs[-1]) <= {"uint", "uint32"}


def test_the_header(tmp_path: Path) -> None:
    layers = everything()
    del layers["id"]
    camera = tilted_camera(WIDTH, HEIGHT)
    header = FrameFileHeader({"clsplat:frame": 7, "Software": "clsplat"}, camera_matrices(camera))
    write_channels(tmp_path / "a.exr", layers, Encoding(compression="piz"), header)
    _, (spec,) = read(tmp_path / "a.exr")
    assert spec.getattribute("clsplat:frame") == 7
    assert spec.get_string_attribute("compression") == "piz"
    found = exr_attributes(tmp_path / "a.exr")
    for name, matrix in header.matrices.items():
        kind, data = found[name]
        assert kind == "m44f"
        np.testing.assert_allclose(np.frombuffer(data, "<f4").reshape(4, 4), matrix, rtol=1e-6, atol=1e-6)
    assert sorted(header.matrices) == ["worldToCamera", "worldToNDC"]
    assert "worldToScreen" not in found and "chromaticities" not in found


def test_matrices_put_a_point_on_its_pixel() -> None:
    camera = tilted_camera(WIDTH, HEIGHT)
    point = np.array([0.3, -0.2, 4.0])
    p = camera.rotation @ point + camera.translation
    pixel = camera.fx * p[0] / p[2] + camera.cx, camera.fy * p[1] / p[2] + camera.cy
    matrices = camera_matrices(camera)
    in_camera = np.append(point, 1) @ matrices["worldToCamera"]
    np.testing.assert_allclose(in_camera, [p[0], -p[1], p[2], 1], rtol=1e-12)
    clip = np.append(point, 1) @ matrices["worldToNDC"]
    ndc = clip[:3] / clip[3]
    np.testing.assert_allclose(ndc[0] * WIDTH, pixel[0], rtol=1e-12)
    np.testing.assert_allclose(ndc[1] * HEIGHT, pixel[1], rtol=1e-12)
    near = np.array([0, 0, camera.near, 1]) @ np.linalg.inv(matrices["worldToCamera"]) @ matrices["worldToNDC"]
    np.testing.assert_allclose(near[2] / near[3], 0.0, atol=1e-9)


@pytest.mark.parametrize("far", [np.inf, 20.0])
def test_matrices_of_an_orthographic_camera(far: float) -> None:
    camera = replace(tilted_camera(WIDTH, HEIGHT, 9.0), far=far, near=0.5, projection="orthographic")
    matrices = camera_matrices(camera)
    points = np.array([[0.3, -0.2, 4.0], [1.0, 2.0, 7.0]])
    pixels, depths = pixel_from_world(camera, points)
    ndc = np.concatenate([points, np.ones((2, 1))], axis=1) @ matrices["worldToNDC"]
    np.testing.assert_allclose(ndc[:, 3], 1, rtol=1e-12)
    np.testing.assert_allclose(ndc[:, 0] * WIDTH, pixels[:, 0], rtol=1e-12)
    np.testing.assert_allclose(ndc[:, 1] * HEIGHT, pixels[:, 1], rtol=1e-12)
    wanted = (depths - 0.5) * (1 / 19.5 if far == 20.0 else 1)
    np.testing.assert_allclose(ndc[:, 2], wanted, rtol=1e-12)
    assert camera_matrices(replace(camera, projection="fisheye")) == {}


def test_a_window(tmp_path: Path) -> None:
    write_channels(
        tmp_path / "a.exr", everything(), Encoding(parts="several"), FrameFileHeader(window=Window(5, 3, 100, 50))
    )
    _, (spec, *_) = read(tmp_path / "a.exr")
    assert (spec.x, spec.y, spec.width, spec.height) == (5, 3, WIDTH, HEIGHT)
    assert (spec.full_x, spec.full_y, spec.full_width, spec.full_height) == (0, 0, 100, 50)


def test_what_a_half_cannot_hold_is_its_largest(tmp_path: Path) -> None:
    layers = {"rgb": np.full((4, 4, 3), 1e9, np.float32), "depth": np.full((4, 4), 1e9, np.float32)}
    write_channels(tmp_path / "a.exr", layers, Encoding("half"))
    found, _ = read(tmp_path / "a.exr")
    assert (found["R"] == 65504).all()
    assert (found["Z"] == 1e9).all()


@pytest.mark.parametrize(
    ("extension", "bits"), [("png", 8), ("png", 16), ("tif", 16), ("tif", 8), ("jpg", 8), ("dpx", 16)]
)
def test_pictures(extension: str, bits: int, tmp_path: Path) -> None:
    alpha = np.full((HEIGHT, WIDTH), 0.5, np.float32)
    rgb = np.full((HEIGHT, WIDTH, 3), 0.25, np.float32)
    rgb[0, 0] = (-1.0, 2.0, np.nan)
    layers = {"rgb": rgb} if extension == "jpg" else {"rgb": rgb, "alpha": alpha}
    write_channels(tmp_path / f"a.{extension}", layers, Encoding(bits=bits))
    source = oiio.ImageInput.open(str(tmp_path / f"a.{extension}"), oiio.ImageSpec())
    spec = source.spec()
    assert str(spec.format) == f"uint{bits}"
    pixels = source.read_image(oiio.FLOAT)
    # OpenImageIO gives associated values, whatever the file has; a JPEG loses a few levels, 8 bits half of one.
    tolerance = 0.03 if extension == "jpg" else 1.5 / (2**bits - 1)
    np.testing.assert_allclose(pixels[-1, -1, :3], 0.25, atol=tolerance)
    if extension != "jpg":
        np.testing.assert_allclose(pixels[:, :, 3], 0.5, atol=tolerance)


@pytest.mark.parametrize(("extension", "bits"), [("png", 8), ("png", 16), ("dpx", 10), ("dpx", 16)])
def test_every_step_of_a_picture(extension: str, bits: int, tmp_path: Path) -> None:
    """What lies nearest a step becomes it; what is no colour the least or the largest."""
    most, count = 2**bits - 1, 16
    steps = np.linspace(0, most, count * count).round().reshape(count, count)
    rgb = np.stack([steps, np.maximum(steps - 0.49, 0), np.minimum(steps + 0.49, most)], axis=2) / most
    rgb[0, :4, 0] = (np.nan, -np.inf, -1e38, -0.0)
    rgb[1, :3, 0] = (np.inf, 3.4e38, 1.0)
    wanted = np.repeat(steps[:, :, None], 3, axis=2)
    wanted[0, :4, 0], wanted[1, :3, 0] = 0, most
    planes = np.ascontiguousarray(rgb.transpose(2, 0, 1), np.float32)  # as they come from a device
    for layer in (planes.transpose(1, 2, 0), np.ascontiguousarray(planes.transpose(1, 2, 0))):
        write_channels(tmp_path / f"a.{extension}", {"rgb": layer}, Encoding(bits=bits))
        source = oiio.ImageInput.open(str(tmp_path / f"a.{extension}"))
        found = source.read_image(oiio.UINT8 if bits == 8 else oiio.UINT16)
        found = found >> 6 if bits == 10 else found  # OpenImageIO gives them in 16
        np.testing.assert_array_equal(found, wanted)


@pytest.mark.needs("av")
def test_a_dpx_as_another_reader_sees_it(tmp_path: Path) -> None:
    """All 1024 steps of ten bits, white too, by FFmpeg; and a header without names, times and paths."""
    import av

    steps = np.arange(1024).reshape(32, 32)
    rgb = np.stack([steps, steps[::-1], np.full_like(steps, 1023)], axis=2)
    header = FrameFileHeader({"Software": "clsplat 1", "clsplat:model": "ab" * 32, "clsplat:settings": "c0" * 16})
    write_channels(tmp_path / "a.dpx", {"rgb": (rgb / 1023).astype(np.float32)}, Encoding(bits=10), header)
    with av.open(str(tmp_path / "a.dpx")) as container:
        (frame,) = container.decode(video=0)
    assert frame.format.name == "gbrp10le"
    planes = [np.frombuffer(plane, np.uint16).reshape(32, -1)[:, :32] for plane in frame.planes]
    np.testing.assert_array_equal(np.stack([planes[2], planes[0], planes[1]], axis=2), rgb)
    head = (tmp_path / "a.dpx").read_bytes()[:2048]
    assert head[:4] == b"SDPX"
    assert head[36:160] == bytes(124)  # name and time
    assert str(tmp_path).encode() not in head
    assert b"a.dpx" not in head
    assert attribute(tmp_path / "a.dpx", "clsplat:model") == "ab" * 32
    assert attribute(tmp_path / "a.dpx", "clsplat:settings") == "c0" * 16
    assert attribute(tmp_path / "a.dpx", "clsplat:frame") is None


def test_channels_by_name() -> None:
    assert parse_channels("depth, rgb") == ("rgb", "depth")
    for text, message in (("rgb,colour", "has 'colour', expected some of rgb, alpha"), (" ,", "is empty")):
        refuses(message, parse_channels, text)


@pytest.mark.parametrize(
    ("path", "channels", "message"),
    [
        ("a.png", ("rgb", "depth"), "a PNG cannot hold depth; write .exr"),
        ("a.jpg", ("rgb", "alpha"), "a JPG cannot hold alpha"),
        ("a.tif", ("alpha",), "a TIF needs rgb"),
        ("a.tga", ("rgb",), "has the extension '.tga'"),
        ("a", ("rgb",), "has the extension 'none'"),
    ],
)
def test_formats_that_cannot(path: str, channels: tuple[str, ...], message: str) -> None:
    refuses(message, check_format, path, channels)


def test_nowhere_to_write(tmp_path: Path) -> None:
    layers = {"rgb": np.zeros((4, 4, 3), np.float32)}
    refuses("no such folder to write", write_channels, tmp_path / "none" / "a.exr", layers)
    (tmp_path / "a.exr").mkdir()
    refuses(r"a\.exr: cannot be written", write_channels, tmp_path / "a.exr", layers, error=ClsplatError)
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


@pytest.mark.slow
@pytest.mark.parametrize("extension", ["exr", "tif", "png", "jpg", "dpx"])
def test_the_same_bytes_a_second_later(extension: str, tmp_path: Path) -> None:
    layers = everything() if extension == "exr" else {"rgb": everything()["rgb"]}
    for name in ("a", "b"):
        bits = 10 if extension == "dpx" else 8
        write_channels(tmp_path / f"{name}.{extension}", layers, Encoding(parts="several", bits=bits))
        time.sleep(1.1 if name == "a" else 0)
    assert (tmp_path / f"a.{extension}").read_bytes() == (tmp_path / f"b.{extension}").read_bytes()
