# SPDX-License-Identifier: Apache-2.0
"""`clsplat convert` and `clsplat info` from the command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import Capture, fails, printed, ran
from models import assert_equal, random_gaussians
from rendered import camera_file
from scipy.spatial.transform import Rotation
from splats import lopsided
from systems import can_link
from tiny import cameras, hidden_model

from clsplat.cli.main import main
from clsplat.gaussians import Gaussians
from clsplat.images import colour
from clsplat.models import difference, edit, formats


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "model.ply"
    random_gaussians(300, 2).save(path)
    return path


def convert(*arguments: object) -> int:
    return main(["convert", *map(str, arguments)])


def told(capsys: Capture, *arguments: object) -> Any:
    """The answer of a call to --json."""
    return json.loads(printed(capsys, [*arguments, "--json"]).out)


@pytest.mark.smoke
def test_what_was_lost_is_said(model: Path, capsys: Capture) -> None:
    target = model.with_suffix(".splat")
    said = ran(capsys, convert, model, target).out
    assert f"{model}: 3DGS PLY, 300 Gaussians of SH degree 2, " in said
    assert f"{target}: splat, 300 Gaussians of SH degree 0, 9,600 bytes" in said
    for name in ("position", "scale", "rotation", "opacity", "colour", "SH"):
        assert f"\n{name} " in said
    errors = (found := told(capsys, "convert", model, target, "--overwrite"))["errors"]
    whole, read = Gaussians.load(model), Gaussians.load(target)
    assert errors["position"]["largest"] == 0
    assert errors["sh"]["largest"] == pytest.approx(np.abs(whole.sh[:, 1:]).max())
    p, q = (each.quaternions / np.linalg.norm(each.quaternions, axis=1)[:, None] for each in (whole, read))
    angle = (Rotation.from_quat(p[:, [1, 2, 3, 0]]).inv() * Rotation.from_quat(q[:, [1, 2, 3, 0]])).magnitude()
    assert errors["rotation"]["largest"] == pytest.approx(np.degrees(angle.max()), rel=1e-3)
    opacity = [1 / (1 + np.exp(-each.opacity_logits.astype(float))) for each in (whole, read)]
    assert errors["opacity"]["largest"] == pytest.approx(np.abs(opacity[0] - opacity[1]).max())
    assert 0 < errors["opacity"]["largest"] <= 0.5 / 255 * 1.001  # half a step of a byte
    assert found["target"]["bytes"] == target.stat().st_size


def test_rows_in_another_order_are_compared_with_their_own(model: Path, capsys: Capture) -> None:
    target = model.with_suffix(".compressed.ply")
    errors = told(capsys, "convert", model, target)["errors"]
    assert 0 < errors["position_relative"]["largest"] < 1e-3  # 10 bits of two chunks of the model
    assert 0 < errors["rotation"]["largest"] < 0.5  # 10 bits


def test_edits_are_made_in_the_order_of_the_help(model: Path, tmp_path: Path) -> None:
    other, target, matrix = tmp_path / "other.ply", tmp_path / "out.ply", tmp_path / "matrix.txt"
    random_gaussians(50, 3, seed=4).save(other)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("xyz", (0.3, 0.2, -1)).as_matrix()
    turn[:3, 3] = (1, 2, 3)
    matrix.write_text("\n".join(" ".join(map(repr, row)) for row in turn.tolist()))
    flags = ["--merge", other, "--crop=-1,-1,-1,1,1.5,2", "--crop-sphere", "0,0,0,1.4", "--prune-opacity", 0.3]
    assert convert(model, target, *flags, "--transform", matrix, "--scale", 2, "--drop-sh", 1) == 0
    wanted = edit.merge([Gaussians.load(model), Gaussians.load(other)])
    wanted = edit.take(wanted, edit.in_box(wanted, (-1, -1, -1), (1, 1.5, 2)))
    wanted = edit.take(wanted, edit.in_sphere(wanted, (0, 0, 0), 1.4))
    wanted = edit.take(wanted, edit.opaque(wanted, 0.3))
    wanted = edit.drop_sh(edit.transform(wanted, edit.scaling(2) @ turn), 1)
    assert 5 < len(wanted) < 300
    assert_equal(Gaussians.load(target), wanted)
    inline = ",".join(map(str, turn.ravel()))
    assert convert(model, tmp_path / "a.ply", "--transform", matrix) == 0
    assert convert(model, tmp_path / "b.ply", f"--transform={inline}") == 0
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_a_model_is_turned_scaled_and_moved(model: Path) -> None:
    """By --rotate about x, then y, then z; --scale and --translate follow, and --transform comes first."""
    target = model.with_name("out.ply")
    quarter = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])  # x to y by z, after y to z by x
    wanted = np.eye(4)
    wanted[:3, :3], wanted[:3, 3] = 2 * quarter, (1, -2, 3)
    assert convert(model, target, "--rotate", "90,0,90", "--scale", 2, "--translate", "1,-2,3") == 0
    whole, read = Gaussians.load(model), Gaussians.load(target)
    x, y, z = whole.means.T
    assert np.allclose(read.means, np.column_stack([2 * z + 1, 2 * x - 2, 2 * y + 3]), atol=1e-6)  # float32 of about 3
    assert_equal(read, edit.transform(whole, edit.shifting((1, -2, 3)) @ edit.scaling(2) @ edit.turning((90, 0, 90))))
    assert np.allclose(edit.turning((90, 0, 90))[:3, :3], quarter, atol=1e-12)
    half, back = model.with_name("half.ply"), model.with_name("back.ply")
    assert convert(model, half, "--scale", 0.5) == 0
    first = "--transform=" + ",".join(map(str, np.diag([4, 4, 4, 1.0]).ravel()))
    assert convert(half, back, "--translate=1,0,0", first) == 0
    assert np.allclose(Gaussians.load(back).means, 2 * whole.means + (1, 0, 0), atol=1e-6)


def test_bands_that_are_zero_are_not_rounded(tmp_path: Path, capsys: Capture) -> None:
    """A format that rounds has no zero among its steps, so empty bands are left out first; one of floats keeps them."""
    model = random_gaussians(300, 3)
    model.sh[:, 4:] = 0
    source = tmp_path / "model.ply"
    model.save(source)
    for name, degree in (("a.compressed.ply", 1), ("a.spz", 1), ("a.sog", 1), ("a.glb", 3), ("b.ply", 3)):
        assert told(capsys, "convert", source, tmp_path / name)["target"]["sh_degree"] == degree
    model.sh[7, 15, 2] = 1e-3
    model.save(source)
    assert edit.without_empty_bands(model) is model
    model.sh[:, 1:] = 0
    assert edit.without_empty_bands(model).sh_degree == 0


def test_bits_of_spz_are_chosen(tmp_path: Path, capsys: Capture) -> None:
    """Fewer are a smaller file that is farther off: each lost bit is a step twice as wide."""
    model, found = tmp_path / "lopsided.ply", {}
    lopsided().save(model)
    for bits in ("8", "6", "6,6", "5,4", "2", "1,8"):
        target = model.with_name(f"{bits}.spz")
        result = told(capsys, "convert", model, target, "--sh-bits", bits)
        found[bits] = result["target"]["bytes"], result["errors"]["sh"]["largest"]
    assert found["6"] == found["6,6"]
    for more, fewer in (("8", "6"), ("6", "5,4"), ("5,4", "2")):
        assert found[more][0] > found[fewer][0]
        assert found[more][1] < found[fewer][1]
    step = 1 / 128
    assert found["8"][1] <= 0.5 * step * 1.001
    assert 6 * step < found["5,4"][1] <= 8.5 * step * 1.001  # half of 16 steps, after rounding to one
    read = Gaussians.load(model.with_name("1,8.spz"))
    exact, source = Gaussians.load(model.with_name("8.spz")), Gaussians.load(model)
    assert np.array_equal(read.sh[:, 4:], exact.sh[:, 4:])
    assert np.abs(read.sh[:, 1:4] - source.sh[:, 1:4]).max() > 0.3  # of a bit for +-1, half is 0.5
    default = model.with_name("plain.spz")
    assert convert(model, default) == 0
    assert default.read_bytes() == model.with_name("6.spz").read_bytes()


def test_what_formats_have_beside_the_model(model: Path) -> None:
    """--spz-version and --up, which changes no Gaussian."""
    for version in (2, 3, 4):
        target = model.with_name(f"{version}.spz")
        assert convert(model, target, "--spz-version", version) == 0
        assert formats.spz.describe(target)["version"] == version
    plain = model.with_name("plain.spz")
    assert convert(model, plain) == 0
    assert plain.read_bytes() == model.with_name("3.spz").read_bytes()
    pytest.importorskip("pxr")
    for up in ("y", "z"):
        target = model.with_name(f"{up}.usda")
        assert convert(model, target, "--up", up) == 0
        assert formats.usd.describe(target)["up_axis"] == up.upper()
    assert np.array_equal(Gaussians.load(target).means, Gaussians.load(model).means)


def test_pruning_by_contribution_leaves_what_the_cameras_see(scene: Path, tmp_path: Path, capsys: Capture) -> None:
    """Half of the model is behind the cameras' backs or far below a pixel: it goes, and the frames stay."""
    seen = hidden_model()
    unseen = edit.transform(seen, edit.scaling(1e-4))
    unseen.means += 100
    both = edit.merge([seen, unseen])
    source, target = tmp_path / "both.ply", tmp_path / "pruned.ply"
    both.save(source)
    found = told(capsys, "convert", source, target, "--prune-contribution", 0.01, "--cameras", scene, "--scene", scene)
    kept = Gaussians.load(target)
    assert 30 <= len(kept) <= len(seen)
    assert np.abs(kept.means).max() < 50
    assert found["scene"]["least_between"] > 60, "what adds less than a hundredth of a pixel is not seen"


def test_pruning_by_contribution_to_an_orthographic_shot(tmp_path: Path, capsys: Capture) -> None:
    seen = hidden_model()
    beside = edit.transform(seen, np.array([[1, 0, 0, 50], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
    edit.merge([seen, beside]).save(tmp_path / "both.ply")
    flat = {"size": (64, 48), "lens": {"pixel_size": 0.05}, "projection": "orthographic"}
    prune = ["--prune-contribution", 0.01, "--cameras", camera_file(tmp_path / "shot.json", {1: 0}, **flat)]
    assert convert(tmp_path / "both.ply", tmp_path / "part.ply", *prune) == 0
    kept = Gaussians.load(tmp_path / "part.ply")
    assert 0 < len(kept) <= len(seen)
    assert np.abs(kept.means).max() < 25
    assert capsys.readouterr().err == ""


def test_psnr_before_and_after_with_cameras_that_move_along(scene: Path, tmp_path: Path, capsys: Capture) -> None:
    source, target = tmp_path / "model.ply", tmp_path / "moved.compressed.ply"
    hidden_model().save(source)
    moved = ["--transform=0,-1,0,4, 0,0,1,5, -1,0,0,6, 0,0,0,1", "--scale", 3]
    found = told(capsys, "convert", source, target, *moved, "--scene", scene)["scene"]
    assert len(found["views"]) == 2, "the held-out ones"
    assert found["before"] > 45, "the pictures are of this model, in 8 bits"
    assert found["between"] > 40
    assert found["after"] < found["before"]
    assert found["after"] > 38
    assert convert(source, tmp_path / "same.ply", "--scene", scene, "--test-every", 0, "--background", "white") == 0
    said = capsys.readouterr().out
    assert f"PSNR of {len(cameras())} views" in said
    assert "between the two renders of a view: 120.00" in said, "the same numbers give the same frames"


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--crop", "1,2,3"], "--crop 1,2,3: expected 6 numbers"),
        (["--crop=0,0,0,1,-1,1"], "expected X0 <= X1"),
        (["--crop=0,0,0,1,nan,1"], "expected 6 numbers"),
        (["--crop=90,90,90,91,91,91"], "--crop: removes all 300 Gaussians"),
        (["--crop-sphere", "0,0,0,-1"], "--crop-sphere: removes all 300"),
        (["--transform", "1,2"], "expected 16 numbers"),
        (["--transform", "1,0,0,0,0,2,0,0,0,0,1,0,0,0,0,1"], "not a similarity"),
        (["--scale", "0"], "--scale 0.0: expected"),
        (["--scale", "nan"], "--scale nan: expected"),
        (["--drop-sh", "4"], "--drop-sh 4: expected 0 to 3"),
        (["--prune-opacity", "-0.1"], "--prune-opacity -0.1: expected 0 to 1"),
        (["--prune-opacity", "1"], "--prune-opacity: removes all 300"),
        (["--prune-contribution", "1"], "--prune-contribution and --cameras need each other"),
        (["--cameras", "x"], "--prune-contribution and --cameras need each other"),
        (["--merge", "nowhere.ply"], "nowhere.ply: no such file"),
        (["--rotate", "90"], "--rotate 90: expected 3 numbers"),
        (["--translate", "1,2,inf"], "--translate 1,2,inf: expected 3 numbers"),
        (["--up", "z"], "out.ply is 3DGS PLY"),
        (["--spz-version", "3"], "--spz-version: is for SPZ files, "),
        (["--sh-bits", "5"], "--sh-bits: is for SPZ files, "),
        *(
            (flags.split(), f"{flags.split()[0]}: has an effect only with --scene, expected --scene too")
            for flags in ("--resolution 200", "--background white", "--test-every 4")
        ),
        *((["--sh-bits", bits], f"--sh-bits {bits}: expected bits from 1 to 8") for bits in ("0", "9,4", "5,4,3", "x")),
    ],
)
def test_wrong_calls_are_one_line_and_write_nothing(
    flags: list[str], message: str, model: Path, capsys: Capture
) -> None:
    target = model.with_name("out.ply")
    assert message in fails(capsys, convert, model, target, *flags)
    assert not target.exists()


def test_a_folder_that_is_not_there(model: Path, capsys: Capture) -> None:
    target = model.parent / "none" / "out.ply"
    said = f"clsplat: error: {target.parent}: no such folder, expected an existing one for out.ply"
    assert fails(capsys, convert, model, target) == said
    assert not target.parent.exists()


@pytest.mark.parametrize("name", ["other.ply", "other.gltf", "meta.json", "link.ply"])
def test_a_file_that_is_there_is_replaced_only_if_asked(name: str, model: Path, capsys: Capture) -> None:
    target = model.parent / name
    if name == "link.ply":
        if not can_link():
            pytest.skip("this user may not make symbolic links")
        target.symlink_to(model.parent / "nowhere.ply")
    else:
        first = {"other.gltf": "other.bin", "meta.json": "quats.webp"}.get(name, name)
        (model.parent / first).write_bytes(b"precious")
        target = model.parent / first
    said = f"clsplat: error: {target}: exists already; name another file, or give --overwrite to replace it"
    assert fails(capsys, convert, model, model.parent / name) == said
    assert name == "link.ply" or target.read_bytes() == b"precious"
    assert convert(model, model.parent / name, "--overwrite") == 0
    assert len(Gaussians.load(model.parent / name)) == 300


def test_a_model_is_changed_in_place_only_if_asked(model: Path, capsys: Capture) -> None:
    before = model.read_bytes()
    for target in (model, model.parent / "." / "x" / ".." / model.name):
        (model.parent / "x").mkdir(exist_ok=True)
        said = fails(capsys, convert, model, target, "--prune-opacity", "0.5")
        assert "is an input, and would be replaced by the result" in said
    other = model.with_name("b.ply")
    random_gaussians(3).save(other)
    assert "b.ply: is an input" in ran(capsys, convert, model, other, "--merge", other, status=2).err
    assert model.read_bytes() == before
    assert convert(model, model, "--prune-opacity", "0.5", "--overwrite") == 0
    assert 0 < len(Gaussians.load(model)) < 300


def test_a_folder_as_output_is_named(model: Path, capsys: Capture) -> None:
    (model.parent / "x.ply").mkdir()
    said = fails(capsys, convert, model, model.parent / "x.ply", "--overwrite")
    assert "x.ply: is a folder, expected the name of a file to write" in said


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="no /proc on this system")
def test_a_place_that_takes_no_files_is_named(model: Path, capsys: Capture) -> None:
    said = "clsplat: error: /proc/x.ply: cannot be written: no file can be made in /proc"
    assert fails(capsys, convert, model, "/proc/x.ply") == said


def test_info_of_a_model_of_nothing(model: Path, capsys: Capture) -> None:
    head = model.read_bytes().partition(b"end_header\n")[0].replace(b"element vertex 300", b"element vertex 0")
    model.write_bytes(head + b"end_header\n")
    said = printed(capsys, ["info", model]).out
    assert "\nGaussians     0\n" in said
    assert "\nSH degree     2, zero beyond 0\n" in said
    assert told(capsys, "info", model)["gaussians"] == 0
    assert "has 0 Gaussians" in ran(capsys, convert, model, model.with_name("b.ply"), status=2).err


@pytest.mark.parametrize(("made", "name"), [(".ply", "a.splat"), (".glb", "a.splat"), (".spz", "a.ply")])
def test_a_file_of_another_kind_than_its_name_says(made: str, name: str, model: Path, capsys: Capture) -> None:
    real = model.with_name(f"real{made}")
    assert convert(model, real) == 0
    wrong = real.rename(model.with_name(name))
    capsys.readouterr()
    said = printed(capsys, ["info", wrong, "--json"])
    kind = formats.format_of(wrong).name
    assert json.loads(said.out)["format"] == kind
    told = f"{wrong}: is {kind} by its content, in spite of its name, and is read as such"
    assert said.err == f"clsplat: warning: {told}\n"
    assert len(formats.load(model)) == 300


def test_any_beginning_may_be_that_of_a_splat(model: Path) -> None:
    target = model.with_suffix(".splat")
    assert convert(model, target) == 0
    data = bytearray(target.read_bytes())
    data[0] = ord("{")
    target.write_bytes(data)
    assert len(Gaussians.load(target)) == 300


def test_the_colour_space_goes_along_or_is_told(model: Path, capsys: Capture) -> None:
    Gaussians.load(model).save(model, comments=[colour.comment("lin_rec709")])
    for suffix in (".b.ply", ".compressed.ply"):
        assert convert(model, target := model.with_suffix(suffix)) == 0
        assert colour.recorded_space(target) == "lin_rec709"
    assert not capsys.readouterr().err
    said = ran(capsys, convert, model, model.with_suffix(".splat")).err
    assert "splat cannot store the colour space, lin_rec709; readers will assume sRGB" in said


@pytest.mark.parametrize("suffix", sorted(s for s in formats.suffixes(writable=True) if s.startswith(".")))
def test_info_of_every_format(suffix: str, model: Path, capsys: Capture) -> None:
    target = model.with_name(f"other{suffix}")
    ran(capsys, convert, model, target)
    found = told(capsys, "info", target)
    whole = Gaussians.load(target)
    assert found["format"] == formats.format_of(target).name
    assert found["gaussians"] == 300
    assert found["sh_degree"] == whole.sh_degree
    assert found["not_finite"] == 0
    np.testing.assert_allclose(found["bounds"]["min"], whole.means.min(axis=0) + whole.origin, rtol=1e-6)
    np.testing.assert_allclose(found["scale"]["p100"], np.exp(whole.log_scales.max()), rtol=1e-5)
    np.testing.assert_allclose(
        found["opacity"]["p50"], np.median(1 / (1 + np.exp(-whole.opacity_logits.astype(float)))), rtol=1e-5
    )
    said = printed(capsys, ["info", target]).out
    assert "\nGaussians     300\n" in said


def spoilt(path: Path, change: Callable[[Any], None]) -> None:
    """Change the vertices, a record array, of a PLY that clsplat wrote, which does not write what is not finite."""
    head, data = path.read_bytes().split(b"end_header\n")
    names = [line.split()[2].decode() for line in head.split(b"\n") if line.startswith(b"property float ")]
    rows = np.frombuffer(data, [(name, "<f4") for name in names]).copy()
    change(rows)
    path.write_bytes(head + b"end_header\n" + rows.tobytes())


def test_info_counts_what_a_reader_leaves_out(model: Path, capsys: Capture) -> None:
    Gaussians.load(model).save(model, comments=["made by hand"])

    def change(rows: Any) -> None:
        rows["y"][3] = rows["f_rest_21"][200] = rows["opacity"][7] = np.nan
        rows["opacity"][[3, 8]], rows["scale_1"][9] = np.inf, -np.inf  # 1 and 0: these are no trouble

    spoilt(model, change)
    said = printed(capsys, ["info", model]).out
    assert "300, 3 of them not finite and left out" in said
    assert "made by hand" in said
    assert "none.ply: no such file" in printed(capsys, ["info", model.with_name("none.ply")], status=2).err
    target = model.with_name("whole.ply")
    error = ran(capsys, convert, model, target).err
    assert "3 of 300 Gaussians have a value that is not finite, the first is a position of Gaussian 3" in error
    assert len(Gaussians.load(target)) == 297


@pytest.mark.parametrize("which", ["opacities", "scales", "both"])
def test_values_that_are_activated_already(model: Path, which: str, capsys: Capture) -> None:
    """The warning names the flag that writes a right model, which gives none."""
    wanted = Gaussians.load(model)

    def change(rows: Any) -> None:
        if which != "scales":
            rows["opacity"] = 1 / (1 + np.exp(-rows["opacity"]))
        if which != "opacities":
            for name in ("scale_0", "scale_1", "scale_2"):
                rows[name] = np.exp(rows[name])

    spoilt(model, change)
    target = model.with_name("right.ply")
    for verb in (["info", str(model)], ["convert", str(model), str(target.with_name("wrong.ply"))]):
        lines = [line for line in printed(capsys, verb).err.splitlines() if f"--activated {which}`" in line]
        warned = [
            name for name in ("opacities", "scales") if any(f": all {name} are between 0.0" in line for line in lines)
        ]
        assert warned == (["opacities", "scales"] if which == "both" else [which])
    assert "warning" not in ran(capsys, convert, model, target, "--activated", which).err
    found = difference.errors(wanted, Gaussians.load(target))
    # float32's rounding of the opacity and the scale, the logarithm of which it is once more
    assert found["opacity"]["largest"] < 1e-6
    assert found["scale"]["largest"] < 1e-6
    other = {"opacities": "scales", "scales": "opacities"}.get(which)
    if other:
        assert "model.ply: Gaussian" in fails(capsys, convert, model, target, "--activated", other, "--overwrite")


@pytest.mark.smoke
def test_a_run_is_its_model(trained: Path, tmp_path: Path, capsys: Capture) -> None:
    assert told(capsys, "info", trained)["path"] == str(trained / "model.ply")
    assert convert(trained, tmp_path / "a.splat") == 0
    assert len(Gaussians.load(tmp_path / "a.splat")) == len(Gaussians.load(trained / "model.ply"))


def test_eval_and_render_take_any_format(trained: Path, scene: Path, tmp_path: Path, capsys: Capture) -> None:
    target = tmp_path / "a.compressed.ply"
    assert convert(trained, target) == 0
    assert main(["eval", str(target), "--scene", str(scene), "--json"]) == 0
    assert main(["render", str(target), "--cameras", str(scene), "-o", str(tmp_path / "{name}.png")]) == 0
    assert len(list(tmp_path.glob("*.png"))) == len(cameras())


def test_a_folder_of_pictures_is_a_model(trained: Path, scene: Path, tmp_path: Path, capsys: Capture) -> None:
    """An unpacked SOG, to every verb that takes a model."""
    folder = tmp_path / "sog"
    folder.mkdir()
    assert convert(trained, folder / "meta.json") == 0
    ran(capsys, convert, folder, tmp_path / "a.ply")
    assert told(capsys, "info", folder)["path"] == str(folder / "meta.json")
    for given in (folder, tmp_path / "a.ply"):
        assert main(["eval", str(given), "--scene", str(scene), "--json"]) == 0
    found = capsys.readouterr().out.split("\n}\n")
    assert json.loads(found[0] + "}")["mean"] == json.loads(found[1] + "}")["mean"]
    assert main(["render", str(folder), "--cameras", str(scene), "-o", str(tmp_path / "{name}.png")]) == 0
    assert len(list(tmp_path.glob("*.png"))) == len(cameras())
    (folder / "meta.json").unlink()
    assert main(["render", str(folder), "--cameras", str(scene), "-o", str(tmp_path / "{name}.png")]) == 2
    assert "not a run" in capsys.readouterr().err


def test_models_that_do_not_go_together(model: Path, tmp_path: Path, capsys: Capture) -> None:
    light, far, near = (tmp_path / f"{name}.ply" for name in ("light", "far", "near"))
    random_gaussians(20, 1).save(light, comments=[colour.comment(colour.LINEAR)])
    placed = random_gaussians(20, 1)
    placed.origin = np.array([4e5, 0, 3e5])
    placed.save(far)
    placed.origin = np.array([4e5, 1.0, 3e5])
    placed.save(near)
    assert (
        f"warning: --merge {light}: its colours are {colour.LINEAR}, but are read as sRGB, the colour space of {model}"
        in ran(capsys, convert, model, tmp_path / "a.ply", "--merge", light).err
    )
    assert convert(model, tmp_path / "b.ply", "--merge", far) == 0
    assert f"--merge {far}: its origin is 500000 world units from the origin of {model}, so" in capsys.readouterr().err
    assert ran(capsys, convert, near, tmp_path / "c.ply", "--merge", far).err == ""


def test_a_near_plane_that_a_format_does_not_keep(model: Path, tmp_path: Path, capsys: Capture) -> None:
    gaussians = Gaussians.load(model)
    gaussians.near = 0.2
    gaussians.save(model)
    assert told(capsys, "info", model)["near"] == 0.2
    assert "\nnear plane    0.2\n" in printed(capsys, ["info", model]).out
    assert ran(capsys, convert, model, tmp_path / "a.ply").err == ""
    said = ran(capsys, convert, model, tmp_path / "a.splat").err
    assert "splat cannot store the near plane 0.2; readers will use 0.01" in said


def test_what_mip_splatting_adds(model: Path, capsys: Capture) -> None:
    head, _, data = model.read_bytes().partition(b"end_header\n")
    rows = np.frombuffer(data, np.uint8).reshape(300, -1)
    rows = np.concatenate([rows, np.full((300, 1), 0.1, "<f4").view(np.uint8)], axis=1)
    model.write_bytes(head + b"property float filter_3D\nend_header\n" + rows.tobytes())
    with pytest.warns(UserWarning, match=r"filter_3D, Mip-Splatting's filter, is ignored; fuse it into the scales"):
        assert len(Gaussians.load(model)) == 300
    assert told(capsys, "info", model)["ignored"] == ["filter_3D"]


def test_pictures_of_sh_that_are_no_more(tmp_path: Path) -> None:
    high, low, target, other = (tmp_path / name for name in ("high.ply", "low.ply", "meta.json", "mine.webp"))
    other.write_bytes(b"mine")
    random_gaussians(30, 1).save(high)
    random_gaussians(30, 0).save(low)
    assert convert(high, target) == 0
    assert len(list(tmp_path.glob("shN_*.webp"))) == 2
    assert convert(low, target, "--overwrite") == 0
    assert not list(tmp_path.glob("shN_*.webp"))
    assert other.exists()
