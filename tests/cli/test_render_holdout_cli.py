# SPDX-License-Identifier: Apache-2.0
"""`clsplat render --holdout` from end to end: a CG sphere in a tiny model, as depth EXR and as deep EXR."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from calls import Capture, fails, ran
from cg import sphere, sphere_samples, write_flat, write_samples
from numpy.typing import NDArray
from pictures import write_pixels
from rendered import camera_file, pixels_of
from tiny import HEIGHT, WIDTH, hidden_model

from clsplat.camera import Camera
from clsplat.cli.main import main
from clsplat.gaussians import Gaussians
from clsplat.images.stmap import write_stmap
from clsplat.reference import holdout as twin
from clsplat.reference import render as reference
from clsplat.shots import choose_shot

CENTRE, RADIUS = (0.1, 0.1, 4.2), 0.9
"""Of the sphere in each frame's camera: in the midst of the model, which is about 4 away."""
COUNT = 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model, a camera that goes to the right, and the sphere's depths of each frame, flat and deep."""
    folder = tmp_path_factory.mktemp("holdout")
    hidden_model().save(folder / "model.ply")
    for frame in choose_shot(camera_file(folder / "cameras.json", {1: -0.5, COUNT: 0.5})).frames:
        write_flat(folder / f"z.{frame.number:04d}.exr", {"Z": sphere(frame.camera, CENTRE, RADIUS)})
        samples = sphere_samples(frame.camera, CENTRE, RADIUS)
        write_samples(folder / f"deep.{frame.number:04d}.exr", (WIDTH, HEIGHT), samples)
    return folder


def render(folder: Path, output: Path, flags: str = "") -> int:
    call = [str(folder / "model.ply"), "--cameras", str(folder / "cameras.json"), "-o", str(output / "a.####.exr")]
    return main(["render", *call, "--progress", "none", *flags.split()])


def pixels(path: Path) -> NDArray[np.float64]:
    return pixels_of(path).astype(np.float64)


def camera_of(folder: Path, number: int) -> Camera:
    return next(frame.camera for frame in choose_shot(folder / "cameras.json").frames if frame.number == number)


def alpha_in_front(folder: Path, surfaces: Any) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(H, W): of frame 2, brute force in float64, and where no rounding decides."""
    gaussians, camera = Gaussians.load(folder / "model.ply"), camera_of(folder, 2).before(0.01)
    forward = reference.forward(gaussians, camera)
    return twin.held_out(forward.projected, WIDTH, HEIGHT, surfaces)[1], forward.blended.margin > 1e-4


def test_a_sphere_as_depth_and_as_deep_exr(folder: Path, tmp_path: Path) -> None:
    camera, cg = camera_of(folder, 2), np.array([0.9, 0.5, 0.1])
    depth, plain = sphere(camera, CENTRE, RADIUS), tmp_path / "plain"
    assert render(folder, plain, "--alpha --frames 2") == 0
    assert render(folder, tmp_path, f"--alpha --frames 2 --holdout {folder}/z.####.exr") == 0
    held, whole = pixels(tmp_path / "a.0002.exr"), pixels(plain / "a.0002.exr")
    opaque = np.ones(depth.shape)
    wanted, sure = alpha_in_front(folder, [(depth, depth, opaque)])
    hit = np.isfinite(depth)
    assert hit.mean() > 0.1 and np.median(whole[hit, 3] - wanted[hit]) > 0.1
    np.testing.assert_allclose(held[sure, 3], wanted[sure], atol=1e-5)  # a few float32 sums
    np.testing.assert_array_equal(held[~hit], whole[~hit])
    # The composite: the sphere under what is in front of it, over what is not there any more.
    composite = held[:, :, :3] + (1 - held[:, :, 3:]) * hit[:, :, None] * cg
    brute = held[:, :, :3] + ((1 - wanted) * hit)[:, :, None] * cg
    assert np.percentile(np.abs(composite - brute)[sure], 99) < 1e-5

    samples = sphere_samples(camera, CENTRE, RADIUS)
    cover = np.array([each[0][0] if each else 0 for each in samples]).reshape(depth.shape)
    at = np.array([each[0][1] if each else np.inf for each in samples]).reshape(depth.shape)
    assert ((cover > 0) & (cover < 1)).any()
    assert render(folder, tmp_path / "soft", f"--alpha --frames 2 --holdout {folder}/deep.####.exr") == 0
    soft, (wanted, sure) = pixels(tmp_path / "soft/a.0002.exr"), alpha_in_front(folder, [(at, at, cover)])
    np.testing.assert_allclose(soft[sure, 3], wanted[sure], atol=1e-5)
    # What is in front of the sphere, from the two pictures (docs/pictures.md, (78)).
    edge = sure & (cover > 0)
    front = (soft[:, :, 3] - (1 - cover) * whole[:, :, 3])[edge] / cover[edge]
    np.testing.assert_allclose(front, alpha_in_front(folder, [(at, at, np.ceil(cover))])[0][edge], atol=2e-4)


@pytest.mark.slow
def test_a_deep_picture_held_out_by_the_sphere(folder: Path, tmp_path: Path) -> None:
    depth = sphere(camera_of(folder, 2), CENTRE, RADIUS)
    assert render(folder, tmp_path, "--deep --frames 2") == 0
    data = oiio.ImageBuf(str(tmp_path / "a.0002.exr")).deepdata()
    left = np.ones(WIDTH * HEIGHT)
    for pixel, surface in enumerate(depth.ravel()):
        for sample in range(data.samples(pixel)):
            if data.deep_value(pixel, 4, sample) < surface:
                left[pixel] *= 1 - data.deep_value(pixel, 3, sample)
    wanted, _ = alpha_in_front(folder, [(depth, depth, np.ones(depth.shape))])
    assert np.percentile(np.abs(1 - left - wanted.ravel()), 99) < 0.03


@pytest.mark.slow
@pytest.mark.needs("distributed")
def test_channels_and_everything_else_at_once_on_a_farm(folder: Path, tmp_path: Path) -> None:
    import distributed

    flags = (
        f"--channels rgb,alpha,depth,normals,count --overscan 3 --supersample 2 --shutter-angle 180 --samples 3 "
        f"--aperture 0.05 --focus 4 --holdout {folder}/deep.####.exr --frames 1-2"
    )
    assert render(folder, tmp_path / "here", flags) == 0
    held = pixels(tmp_path / "here/a.0002.exr")
    assert render(folder, tmp_path / "plain", flags.replace(f"--holdout {folder}/deep.####.exr", "")) == 0
    plain = pixels(tmp_path / "plain/a.0002.exr")
    cover = np.array([bool(each) for each in sphere_samples(camera_of(folder, 2), CENTRE, RADIUS)])
    beside = np.pad(~cover.reshape(HEIGHT, WIDTH), 3, constant_values=True)
    np.testing.assert_array_equal(held[beside], plain[beside])
    assert (held[~beside, 3] < plain[~beside, 3] - 0.05).mean() > 0.5
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None, host="127.0.0.1", protocol="tcp://"
    ) as cluster:
        assert render(folder, tmp_path / "there", f"{flags} --scheduler {cluster.scheduler_address}") == 0
    for path in (tmp_path / "here").iterdir():
        assert (tmp_path / "there" / path.name).read_bytes() == path.read_bytes()


@pytest.mark.slow
def test_frames_are_rendered_again_where_the_cg_changes(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    for name in ("cg", "moved"):
        (tmp_path / name).mkdir()
        for number in (1, 2):
            source = folder / f"z.{number:04d}.exr"
            (tmp_path / name / f"z.{number:04d}.exr").write_bytes(source.read_bytes())
    flags = "--alpha --frames 1-2 --skip-existing --holdout {}/z.####.exr"
    assert render(folder, tmp_path, flags.format(tmp_path / "cg")) == 0
    before = {path: path.stat().st_mtime_ns for path in sorted(tmp_path.glob("*.exr"))}
    assert render(folder, tmp_path, flags.format(tmp_path / "moved")) == 0  # the same contents elsewhere
    assert {path: path.stat().st_mtime_ns for path in before} == before
    depth = sphere(camera_of(folder, 2), CENTRE, 0.5 * RADIUS)
    write_flat(tmp_path / "cg/z.0002.exr", {"Z": depth})
    capsys.readouterr()
    assert render(folder, tmp_path, flags.format(tmp_path / "cg")) == 0
    assert "1 of the existing frames were rendered" in capsys.readouterr().err
    changed = [path.name for path in before if path.stat().st_mtime_ns != before[path]]
    assert changed == ["a.0002.exr"]
    assert render(folder, tmp_path, "--alpha --frames 1 --skip-existing") == 0  # none at all is another picture
    assert (tmp_path / "a.0001.exr").stat().st_mtime_ns != before[tmp_path / "a.0001.exr"]


def test_one_file_for_all_frames_and_the_plan(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    assert render(folder, tmp_path, f"--holdout {folder}/z.0002.exr --frames 1-2 --dry-run --json") == 0
    plan = json.loads(capsys.readouterr().out)
    assert [frame["holdout"] for frame in plan["frames"]] == [str(folder / "z.0002.exr")] * 2
    lines = ran(capsys, render, folder, tmp_path, f"--holdout {folder}/z.####.exr --dry-run").out.splitlines()
    assert f"holdout   {folder}/z.0001.exr to {folder}/z.0003.exr" in lines


@pytest.mark.slow
def test_cg_that_ends_with_the_frame_is_told_with_overscan(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    flags = f"--frames 2 --overscan 4 --holdout {tmp_path}/z.exr"
    write_flat(tmp_path / "z.exr", {"Z": np.full((HEIGHT, WIDTH), 4.0)})
    assert render(folder, tmp_path, flags) == 0
    assert "z.exr: ends at the frame's edge, so nothing is held out in the overscan" in capsys.readouterr().err
    larger = {"Z": np.full((HEIGHT + 8, WIDTH + 8), 4.0)}
    write_flat(tmp_path / "z.exr", larger, size=(WIDTH, HEIGHT), window=(-4, -4, WIDTH + 8, HEIGHT + 8))
    assert "overscan" not in ran(capsys, render, folder, tmp_path, flags).err


def test_a_bent_picture_is_held_out_straight(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    """A map that shifts by whole pixels shows the pixels of the straight picture that is held out; the holdout is of
    the straight frame."""
    places = np.stack(np.meshgrid(np.arange(WIDTH) + 5.5, np.arange(HEIGHT) - 2.5), axis=2)
    write_stmap(tmp_path / "shift.exr", places, WIDTH, HEIGHT)
    flags = f"--frames 2 --channels rgb,alpha,depth --holdout {folder}/z.####.exr"
    assert render(folder, tmp_path / "straight", flags) == 0
    assert render(folder, tmp_path / "bent", f"{flags} --stmap {tmp_path}/shift.exr") == 0
    assert render(folder, tmp_path / "whole", f"--frames 2 --alpha --stmap {tmp_path}/shift.exr") == 0
    straight, bent, whole = (pixels(tmp_path / name / "a.0002.exr") for name in ("straight", "bent", "whole"))
    wanted, got = straight[:-3, 5:], bent[3:, :-5]
    np.testing.assert_allclose(got[:, :, :4], wanted[:, :, :4], atol=1e-5)  # float32 places, through linear light
    np.testing.assert_array_equal(got[:, :, 4], wanted[:, :, 4])
    assert (whole[:, :, 3] - bent[:, :, 3]).max() > 0.1
    capsys.readouterr()
    write_flat(tmp_path / "all.exr", {"Z": np.full((HEIGHT, WIDTH), 4.0)})
    call = f"--frames 2 --holdout {tmp_path}/all.exr --stmap {tmp_path}/shift.exr"
    assert (
        "all.exr: ends at the frame's edge, so nothing is held out where the warped picture extends"
        in ran(capsys, render, folder, tmp_path / "told", call).err
    )


@pytest.mark.parametrize("how", ["inverse", "ray"])
def test_depths_of_other_kinds(folder: Path, tmp_path: Path, how: str) -> None:
    """1 / z, whose 0 is no surface, and distances along the rays, of a file smaller than the frame."""
    camera = camera_of(folder, 2)
    depth, cosines = sphere(camera, CENTRE, RADIUS), camera.cosines()
    assert cosines is not None and cosines.min() < 0.9
    given = 1 / depth if how == "inverse" else depth / cosines
    window = (4, 3, WIDTH - 8, HEIGHT - 6)
    write_flat(tmp_path / "z.exr", {"Z": depth[3:-3, 4:-4]}, size=(WIDTH, HEIGHT), window=window)
    write_flat(tmp_path / "other.exr", {"Z": given[3:-3, 4:-4]}, size=(WIDTH, HEIGHT), window=window)
    flags = "--frames 2 --alpha --holdout"
    assert render(folder, tmp_path / "z", f"{flags} {tmp_path}/z.exr") == 0
    assert render(folder, tmp_path / "other", f"{flags} {tmp_path}/other.exr --holdout.depths {how}") == 0
    assert render(folder, tmp_path / "wrong", f"{flags} {tmp_path}/other.exr") == 0
    wanted, got, wrong = (pixels(tmp_path / name / "a.0002.exr") for name in ("z", "other", "wrong"))
    np.testing.assert_allclose(got, wanted, atol=1e-6)  # no Gaussian is within float32's rounding of the sphere
    assert np.abs(wrong - wanted).max() > 0.01


def test_depths_of_half_floats_are_told(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    depth = np.nan_to_num(sphere(camera_of(folder, 2), CENTRE, RADIUS), posinf=0.0)
    for name, kinds in (("whole", ("half", "float")), ("coarse", ("float", "half"))):
        channels = {"channelnames": ("A", "Z"), "channelformats": tuple(map(oiio.TypeDesc, kinds))}
        pixels = np.stack([np.ones_like(depth), depth], axis=2).astype(np.float32)
        write_pixels(tmp_path / f"{name}.exr", pixels, **channels)
        assert render(folder, tmp_path / name, f"--holdout {tmp_path}/{name}.exr --dry-run") == 0
        told = "coarse.exr: depths are half floats" in capsys.readouterr().err
        assert told == (name == "coarse")


def test_calls_that_make_no_sense(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    write_flat(tmp_path / "nan.exr", {"Z": np.full((HEIGHT, WIDTH), np.nan)})
    held = f"--holdout {folder}/z.####.exr"
    cases = [
        (f"--holdout {folder}/none.####.exr", "none.0001.exr: no such holdout file, expected a depth or deep EXR"),
        (f"{held} --width 20", f"z.0001.exr: has a display window of {WIDTH}x{HEIGHT} pixels, expected 20x"),
        (f"{held} --holdout.channel depth.Z", "has the channels Z, expected depth.Z; give the channel of its depths"),
        ("--holdout.channel Z", "--holdout.channel Z: is for holdouts, expected --holdout with it"),
        (f"{held} --deep", "--deep and --holdout exclude each other: compositing applies holdouts"),
        ("--holdout.depths ray", "--holdout.depths ray: is for holdouts, expected --holdout with it"),
        (f"--holdout {folder}/z.$X.exr --frames 1", "z.$X.exr: no such holdout"),
        (f"--holdout {folder}/z.{{shot}}.exr", "{shot} is not known, expected {name}"),
        (f"--holdout {tmp_path}/nan.exr", "values of Z are NaN, expected depths and alpha of surfaces"),
    ]
    for flags, message in cases:
        assert message in fails(capsys, render, folder, tmp_path / "new", flags), flags
    assert not any((tmp_path / "new").glob("*.exr"))
