# SPDX-License-Identifier: Apache-2.0
"""Deep slices against the float64 twin and the flat picture, and deep EXR files read back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import scenes
from calls import refuses
from compare import assert_close, assert_same_bits
from numpy.typing import NDArray
from quick import quick
from slices import flattened, in_front

from clsplat.camera import Camera, Window
from clsplat.config.pictures import ColourConfig, DeepConfig, Encoding, PictureConfig
from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.frame.deep import render_deep
from clsplat.frame.deep_exr import write_deep
from clsplat.frame.pipeline import FramePipeline, FrameRequest
from clsplat.gaussians import Gaussians
from clsplat.images.colour import LINEAR
from clsplat.images.frame_files import FrameFileHeader, camera_matrices
from clsplat.reference import deep as twin
from clsplat.reference import render as reference
from clsplat.reference.blend import layers
from clsplat.rendering.renderer import Renderer

SCENES = {
    "overlap": scenes.NAMED["overlap"],
    "saturating": scenes.NAMED["saturating"],
    "equal_depth": scenes.NAMED["equal_depth"],
    "cloud": lambda: scenes.random_cloud(600, 8, 70, 50),
    "orthographic cloud": lambda: scenes.orthographic(scenes.random_cloud(600, 8, 70, 50)),
}


def read(path: Path) -> tuple[Any, list[NDArray[np.float64]]]:
    """The specification, and of each pixel its samples (n, 6)."""
    source = oiio.ImageInput.open(str(path))
    assert source is not None, oiio.geterror()
    spec = source.spec()
    data = source.read_native_deep_image()
    source.close()
    pixels = [
        np.array([[data.deep_value(pixel, channel, sample) for channel in range(6)] for sample in range(samples)])
        for pixel, samples in ((pixel, data.samples(pixel)) for pixel in range(spec.width * spec.height))
    ]
    return spec, [samples.reshape(-1, 6) for samples in pixels]


def over(pixels: list[NDArray[np.float64]], spec: Any) -> NDArray[np.float64]:
    """(H, W, 4), by hand."""
    flat = np.zeros((len(pixels), 4))
    for at, samples in enumerate(pixels):
        for sample in samples:
            flat[at] += (1 - flat[at, 3]) * sample[:4]
    return flat.reshape(spec.height, spec.width, 4)


@pytest.mark.parametrize("name", quick(SCENES, "overlap", "orthographic cloud"))
def test_against_the_twin(shaped_device: Device, name: str) -> None:
    gaussians, camera = SCENES[name]()
    got = render_deep(Renderer(shaped_device), gaussians, camera, 5)
    forward = reference.forward(gaussians, camera)
    wanted = twin.deep(forward.projected, camera.width, camera.height, 5)
    # Transmittances are float32 products of a few dozen factors: where they are this near, a slice may begin elsewhere.
    sure = (forward.blended.margin > 1e-4) & (wanted.margin > 3e-6)
    assert sure.mean() > 0.9 and got.shape == wanted.slices.shape
    assert (wanted.slices[:, sure, 3] > 0).sum(axis=0).max() == (1 if name == "equal_depth" else 5)
    # Colours and alphas of a slice are sums of a few dozen float32 products; depths are single values.
    assert_close(got[:, sure, :4], wanted.slices[:, sure, :4], absolute=2e-5)
    assert_close(got[:, sure, 4], wanted.slices[:, sure, 4], relative=1e-6)


def test_gaussians_of_one_depth_are_one_slice(default_device: Device) -> None:
    gaussians, camera = scenes.equal_depth()
    slices = render_deep(Renderer(default_device), gaussians, camera, 16)
    assert not slices[1:].any() and slices[0, :, :, 3].max() > 0.5
    assert set(np.unique(slices[0, :, :, 4])) == {0.0, 3.0}


def test_a_holdout_at_any_depth(default_device: Device) -> None:
    """The alpha in front of each of 40 depths, against the Gaussians one by one in float64."""
    gaussians, camera = scenes.random_cloud(4000, 8, 70, 50)
    forward = reference.forward(gaussians, camera)
    taken = list(layers(forward.projected, camera.width, camera.height))
    depths = forward.projected.depths[[layer.gaussian for layer in taken]]
    slices = render_deep(Renderer(default_device), gaussians, camera, 16)
    total, sure = 1 - forward.blended.transmittance, forward.blended.margin > 1e-4
    assert np.median(forward.blended.count) > 25  # far more than slices
    for depth in np.quantile(depths, np.linspace(0.01, 0.99, 40)):
        wanted = np.zeros(total.shape)
        for layer in taken:
            if projected_depth(forward.projected, layer.gaussian) < depth:
                wanted[layer.box] = np.where(layer.added, 1 - layer.after, wanted[layer.box])
        error = np.abs(in_front(slices, depth) - wanted)[sure]
        assert np.percentile(error, 99) < 0.03
        assert (error <= total[sure] / 16 + 1e-5).all()  # (74): a sixteenth is slack enough whatever the light


def projected_depth(projected: Any, gaussian: int) -> float:
    return float(np.float32(projected.depths[gaussian]))


@pytest.mark.smoke
@pytest.mark.parametrize("projection", ["perspective", "orthographic", "equirectangular", "fisheye"])
@pytest.mark.parametrize("bins", [1, 12])
def test_flattened_it_is_the_picture(default_device: Device, projection: str, bins: int) -> None:
    gaussians, camera = scenes.random_cloud(3000, 8, 150, 100)
    if projection != "perspective":
        focal = {"orthographic": 30.0, "equirectangular": 150 / (2 * np.pi), "fisheye": 140.0}[projection]
        camera = replace(camera, fx=focal, fy=focal, projection=projection)  # type: ignore[arg-type]
    renderer = Renderer(default_device)
    slices = render_deep(renderer, gaussians, camera, bins)
    assert len(slices) == bins
    flat, picture = flattened(slices), renderer.render(gaussians, camera)
    # 1 - u of a bin and its products lose a few units of 6e-8 where the picture's own sums do.
    assert_close(flat[:, :, :3], picture.image, absolute=2e-6)
    assert_close(flat[:, :, 3], picture.alpha, absolute=1e-6)
    there = slices[..., 3] > 0
    assert (slices[..., 4][there] > 0).all() and not slices[~there].any()
    assert (slices[1:, :, :, 4] > slices[:-1, :, :, 4])[there[1:]].all() and not (there[1:] & ~there[:-1]).any()


def test_windows_and_little_memory_change_no_bit() -> None:
    gaussians, camera = scenes.random_cloud(20_000, 4, 300, 200, degree=1)
    whole = render_deep(Renderer(), gaussians, camera, 4)
    part = camera.cropped(37, 21, 100, 60)
    assert_same_bits(render_deep(Renderer(), gaussians, part, 4), np.ascontiguousarray(whole[:, 21:81, 37:137]))
    limit = 14 << 20
    renderer = Renderer(open_device(None, limit))
    assert_same_bits(render_deep(renderer, gaussians, camera, 4), whole)
    assert renderer.device.memory.peak <= limit


def write(
    path: Path,
    renderer: Renderer,
    gaussians: Gaussians,
    camera: Camera,
    bins: int = 16,
    colour: ColourConfig | None = None,
    **how: Any,
) -> None:
    pipeline = FramePipeline(renderer, gaussians, PictureConfig(colour or ColourConfig()))
    draw, convert, rows = pipeline.draw_deep(bins, FrameRequest(lambda _: camera))
    write_deep(path, draw, camera, rows(camera), bins, convert=convert, **how)


def made(tmp_path: Path, camera: Camera | None = None, **options: Any) -> tuple[Path, Gaussians, Camera]:
    gaussians, own = scenes.random_cloud(600, 8, 71, 50)
    camera = camera or own
    write(tmp_path / "a.exr", Renderer(), gaussians, camera, 6, **options)
    assert list(tmp_path.iterdir()) == [tmp_path / "a.exr"]
    return tmp_path / "a.exr", gaussians, camera


def test_a_file(tmp_path: Path) -> None:
    header = FrameFileHeader({"clsplat:frame": 7}, camera_matrices(scenes.tilted_camera(71, 50)))
    empty_at_the_left = scenes.tilted_camera(71, 50).cropped(-48, 0, 119, 50)
    path, gaussians, camera = made(tmp_path, empty_at_the_left, encoding=Encoding(depth="float"), header=header)
    spec, pixels = read(path)
    assert spec.deep and spec.channelnames == ("R", "G", "B", "A", "Z", "ZBack")
    assert spec.get_string_attribute("compression") == "zips"
    assert spec.getattribute("clsplat:frame") == 7 and spec.getattribute("worldtocamera")
    counts = [len(samples) for samples in pixels]
    assert max(counts) > 3 and min(counts) == 0
    for samples in pixels:
        assert (samples[:, 3] > 0).all() and (samples[:, 4] == samples[:, 5]).all()
        assert (samples[1:, 4] > samples[:-1, 4]).all()
    picture = Renderer().render(gaussians, camera)
    wanted = np.concatenate([picture.image, picture.alpha[:, :, None]], axis=2)
    assert_close(over(pixels, spec), wanted, absolute=2e-6)  # as above
    flat = oiio.ImageBufAlgo.flatten(oiio.ImageBuf(str(path)))
    assert not flat.geterror()
    assert_close(flat.get_pixels(oiio.FLOAT)[:, :, :4], wanted, absolute=2e-6)


def test_halves_and_a_window(tmp_path: Path) -> None:
    camera = scenes.tilted_camera(71, 50).cropped(5, 3, 40, 30)
    header = FrameFileHeader(window=Window(5, 3, 71, 50))
    path, gaussians, _ = made(tmp_path, camera, encoding=Encoding("half", compression="piz"), header=header)
    spec, pixels = read(path)
    assert (spec.x, spec.y, spec.width, spec.height, spec.full_width, spec.full_height) == (5, 3, 40, 30, 71, 50)
    assert [str(kind) for kind in spec.channelformats] == ["half"] * 4 + ["float"] * 2
    picture = Renderer().render(gaussians, scenes.tilted_camera(71, 50))
    # Six samples of halves, each good to 2^-12 of its own.
    assert_close(over(pixels, spec)[:, :, :3], picture.image[3:33, 5:45], absolute=6 * 2**-11)


def test_strips_make_the_same_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, *_ = made(tmp_path)
    whole = path.read_bytes()
    monkeypatch.setattr("clsplat.frame.strips.DEEP_STRIP_FLOATS", 71 * 5 * 6 * 16)
    made(tmp_path)
    assert path.read_bytes() == whole


@pytest.mark.slow
def test_files_in_little_memory(tmp_path: Path) -> None:
    gaussians, camera = scenes.random_cloud(20_000, 4, 300, 200, degree=1)
    limit = 14 << 20  # the slices of all of it are 23 MB
    renderer = Renderer(open_device(None, limit))
    write(tmp_path / "little.exr", renderer, gaussians, camera)
    assert renderer.device.memory.peak <= limit
    write(tmp_path / "plenty.exr", Renderer(), gaussians, camera)
    assert (tmp_path / "little.exr").read_bytes() == (tmp_path / "plenty.exr").read_bytes()


def test_colours_are_converted(tmp_path: Path) -> None:
    path, *_ = made(tmp_path, encoding=Encoding(depth="float"))
    _, plain = read(path)
    _, linear = read(made(tmp_path, encoding=Encoding(depth="float"), colour=ColourConfig(colorspace=LINEAR))[0])
    sample, converted = (max(pixels, key=len)[0] for pixels in (plain, linear))
    straight = sample[:3] / sample[3]
    wanted = np.where(straight > 0.04045, ((straight + 0.055) / 1.055) ** 2.4, straight / 12.92) * sample[3]
    assert_close(converted[:3], wanted, relative=1e-5, absolute=1e-7)
    assert_close(converted[3:], sample[3:])


def test_what_cannot_be(tmp_path: Path) -> None:
    gaussians, camera = scenes.one()
    refuses(r"a\.png: deep samples need an \.exr file", write, tmp_path / "a.png", Renderer(), gaussians, camera)
    for config, message in (
        (DeepConfig(bins=0), "--deep.bins 0: expected 1 to 256"),
        (DeepConfig(bins=257), "--deep.bins 257: expected 1 to 256"),
    ):
        refuses(message, config.check)


def test_a_model_that_counts_from_far_away() -> None:
    gaussians, camera = scenes.random_cloud(600, 8, 70, 50)
    origin = np.array([4e5, -3e5, 2e5])
    far = replace(gaussians, origin=origin)
    away = replace(camera, translation=camera.translation - camera.rotation @ origin)
    picture = Renderer().render(far, away)
    assert picture.alpha.max() > 0.5
    flat = flattened(render_deep(Renderer(), far, away, 5))
    assert_close(flat[:, :, 3], picture.alpha, absolute=1e-6)  # as above
