# SPDX-License-Identifier: Apache-2.0
"""The table of channels against all that goes by it: the kernels, the renderer's planes, samples and files."""

from __future__ import annotations

import re
from itertools import groupby
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest

from clsplat.camera import Camera
from clsplat.config.channels import FRAME_CHANNELS, Channel, feature_names, light_and_rest
from clsplat.config.pictures import Encoding
from clsplat.device.source import kernel_root
from clsplat.frame.draw import drawn_by, feature_floats
from clsplat.images.frame_files import is_whole, parse_channels, write_channels
from clsplat.stages.channels import DEPTH_PLANES, FEATURE_WIDTHS, WHOLE_NUMBER_PLANES, Features

CAMERA = Camera(8, 6, 9.0, 9.0, 4.0, 3.0, np.eye(3), np.zeros(3))
ROUGHNESS = Channel(("rough.x", "rough.y"), "exact", "rough", "features", "roughness", signs=(-1, 1))
"""A channel that there is not, whose row comes before those of whole numbers."""


def kernel(name: str) -> str:
    return (kernel_root() / name).read_text("utf-8")


def test_every_feature_has_its_define_in_the_kernel_and_the_other_way_round() -> None:
    text = kernel("features.cl")
    written = {name.lower() for name in re.findall(r"row(?:\[| \+ )FEATURE_([A-Z0-9_]+)", text)}
    guarded = {name.lower() for name in re.findall(r"#ifdef FEATURE_([A-Z0-9_]+)", text)}
    assert written == guarded == set(FEATURE_WIDTHS)
    assert {name.lower() for name in re.findall(r"FEATURE_([A-Z0-9_]+)", kernel("channels.cl"))} <= set(FEATURE_WIDTHS)


def test_the_planes_behind_the_features_are_those_of_the_kernel() -> None:
    text = kernel("channels.cl")
    assert f"#define PLANES (FEATURES + {len(DEPTH_PLANES)})" in text
    for offset, name in enumerate(DEPTH_PLANES):
        place = f"(FEATURES + {offset})" if offset else "FEATURES"
        assert f"#define {name.upper()} {place}" in text
    assert re.findall(r"(\w+)\[cell\], whole \+ (plane \+ )?pixel", text) == [("count", ""), ("heaviest", "plane + ")]
    assert WHOLE_NUMBER_PLANES == ("count", "index")


def test_a_frame_taken_apart_has_every_plane_once() -> None:
    features = Features.of(FEATURE_WIDTHS)
    assert features.defines == {
        "FEATURES": 11,
        "FEATURE_DEPTH": 0,
        "FEATURE_NORMAL": 1,
        "FEATURE_POSITION": 4,
        "FEATURE_MOTION": 7,
        "FEATURE_BACKWARD": 9,
    }
    means, whole = np.arange(13.0).reshape(1, 1, 13), np.arange(20, 22).reshape(1, 1, 2)
    planes = features.named(means, whole)
    rest = [channel for channel in FRAME_CHANNELS.values() if not channel.is_light]
    assert set(planes) == {channel.kernel for channel in rest}
    for channel in rest:
        count = len(channel.names)
        assert planes[channel.kernel].shape == ((1, 1) if count == 1 else (1, 1, count))
    together = np.concatenate([planes[channel.kernel].ravel() for channel in rest])
    assert sorted(together) == [*range(13), 20, 21]


def test_light_is_what_files_call_colour_of_the_image() -> None:
    light, rest = light_and_rest(FRAME_CHANNELS)
    assert light == ["rgb", "alpha"]
    assert light + rest == list(FRAME_CHANNELS)


@pytest.mark.parametrize("depth", ["half", "float"])
def test_a_file_has_the_names_and_kinds_of_the_table(tmp_path: Path, depth: Any) -> None:
    planes = {name: np.ones((4, 5, len(channel.names)), np.float32) for name, channel in FRAME_CHANNELS.items()}
    write_channels(tmp_path / "a.exr", planes, Encoding(depth))
    spec = oiio.ImageInput.open(str(tmp_path / "a.exr")).spec()
    wanted = {name: channel.kind for channel in FRAME_CHANNELS.values() for name in channel.names}
    formats = [str(kind) for kind in spec.channelformats] or [str(spec.format)] * spec.nchannels
    assert dict(zip(spec.channelnames, formats, strict=True)) == {
        name: "half" if kind == "colour" and depth == "half" else "float" for name, kind in wanted.items()
    }


@pytest.mark.parametrize("names", [tuple(FRAME_CHANNELS), ("rgb", "median", "count"), ("rgb", "normals", "id")])
@pytest.mark.parametrize("parts", ["one", "several"])
def test_a_file_of_any_channels_is_known_to_be_whole(tmp_path: Path, names: tuple[str, ...], parts: Any) -> None:
    """OpenImageIO gives an EXR's channels back in an order of its own."""
    planes = {name: np.ones((4, 5, len(FRAME_CHANNELS[name].names)), np.float32) for name in names}
    write_channels(tmp_path / "a.exr", planes, Encoding(parts=parts))
    assert is_whole(tmp_path / "a.exr", 5, 4, names, Encoding(parts=parts))
    assert not is_whole(tmp_path / "a.exr", 5, 4, names[:-1], Encoding(parts=parts))


def test_one_more_row_goes_all_the_way_to_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(FRAME_CHANNELS, "rough", ROUGHNESS)
    monkeypatch.setitem(FEATURE_WIDTHS, "roughness", 2)
    names = parse_channels("rgb,rough")
    assert feature_names(names) == ("roughness",)
    assert feature_floats(names) == 3
    assert Features.of(("roughness",)).defines == {"FEATURES": 3, "FEATURE_DEPTH": 0, "FEATURE_ROUGHNESS": 1}

    def render_channels(_: object, camera: Camera, wanted: tuple[str, ...], **__: Any) -> Any:
        assert wanted == ("roughness",)
        size = (camera.height, camera.width)
        picture = SimpleNamespace(image=np.zeros((*size, 3), np.float32), alpha=np.zeros(size, np.float32))
        return picture, {"roughness": np.full((*size, 2), 3.0, np.float32)}

    renderer: Any = SimpleNamespace(render_channels=render_channels)
    planes = drawn_by(renderer, None)(CAMERA, names)  # type: ignore[arg-type]
    write_channels(tmp_path / "a.exr", planes)
    source = oiio.ImageInput.open(str(tmp_path / "a.exr"))
    assert source.spec().channelnames == ("R", "G", "B", "rough.x", "rough.y")
    assert (np.asarray(source.read_image(oiio.FLOAT))[:, :, 3:] == [-3, 3]).all()


def test_channels_of_one_part_stand_together() -> None:
    parts = [channel.part for channel in FRAME_CHANNELS.values()]
    assert [part for part, _ in groupby(parts)] == list(dict.fromkeys(parts))
