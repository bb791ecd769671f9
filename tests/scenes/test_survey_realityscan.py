# SPDX-License-Identifier: Apache-2.0
"""XMP files of RealityScan: lenses, photographs without a pose, and files that are wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import ring
import survey_files
from calls import refusal, refuses

from clsplat.scenes.dataset import DataSet
from clsplat.scenes.folder_layouts import detect
from clsplat.scenes.loading import load_scene
from clsplat.scenes.readers.surveys.realityscan import MAX_XMP_BYTES, read_xmp


def xmp(folder: Path, model: str, coefficients: str) -> DataSet:
    attributes = f'xcr:DistortionModel="{model}" xcr:DistortionCoeficients="{coefficients}"'
    return read_xmp(survey_files.write_xmp(folder, attributes=attributes), None)


@pytest.mark.parametrize(
    ("model", "coefficients", "name", "distortion"),
    [
        ("perspective", "0 0 0 0 0 0", "PINHOLE", ()),
        ("division", "0 0 0 0 0 0", "PINHOLE", ()),
        ("brown3", ".1 .2 0 0 0 0", "OPENCV", (0.1, 0.2, 0, 0)),
        ("brown4", ".1 .2 .3 0 0 0", "FULL_OPENCV", (0.1, 0.2, 0, 0, 0.3, 0, 0, 0)),
        ("brown3t2", ".1 .2 .3 0 .01 .02", "FULL_OPENCV", (0.1, 0.2, 0.02, 0.01, 0.3, 0, 0, 0)),
    ],
)
def test_lenses_of_realityscan(
    tmp_path: Path, model: str, coefficients: str, name: str, distortion: tuple[float, ...]
) -> None:
    lens = xmp(tmp_path, model, coefficients).images[0].lens
    assert lens.model == name
    assert lens.params == pytest.approx((40, 40, 24, 16, *distortion))


REAL_XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/">
  <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
    <rdf:Description xcr:Version="3" xcr:PosePrior="initial" xcr:Coordinates="absolute" xcr:DistortionModel="brown3t2"
       xcr:Skew="0" xcr:AspectRatio="1.01" xcr:CalibrationPrior="initial" xcr:InTexturing="1"
       xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">
      <xcr:Rotation>1 0 0 0 0 -1 0 1 0</xcr:Rotation>
      <xcr:Position>3 4 5</xcr:Position>
      <xcr:FocalLength35mm>27</xcr:FocalLength35mm>
      <xcr:PrincipalPointU>0.01</xcr:PrincipalPointU>
      <xcr:PrincipalPointV>-0.02</xcr:PrincipalPointV>
      <xcr:DistortionCoeficients>0.1 -0.05 0.02 0 0.003 -0.004</xcr:DistortionCoeficients>
    </rdf:Description>
  </rdf:RDF>
</x:xmpmeta>
"""


def test_an_upright_photograph_of_version_3(tmp_path: Path) -> None:
    """Values as elements; lengths in pictures count in the longer side, here the height. The formula is written out."""
    ring.write_pictures(tmp_path, ["a.png"], (30, 40))
    (tmp_path / "a.xmp").write_text(REAL_XMP)
    image = read_xmp(tmp_path, None).images[0]
    np.testing.assert_allclose(image.rotation @ [3, 6, 5] + image.translation, [0, 0, 2], atol=1e-12)  # looks along y
    x, y = 0.2, -0.1
    r2 = x * x + y * y
    radial, t1, t2 = 1 + 0.1 * r2 - 0.05 * r2**2 + 0.02 * r2**3, 0.003, -0.004
    x1 = x * radial + t1 * (r2 + 2 * x * x) + 2 * t2 * x * y
    y1 = y * radial + t2 * (r2 + 2 * y * y) + 2 * t1 * x * y
    focal = 27 / 36 * 40
    wanted = [focal * x1 + 40 * 0.01 + 15, 1.01 * focal * y1 - 40 * 0.02 + 20]
    np.testing.assert_allclose(image.lens.img_from_cam(np.array([[0.2, -0.1, 1.0]]))[0], wanted, rtol=1e-9)


def test_photographs_without_a_position_are_left_out(tmp_path: Path) -> None:
    survey_files.write_xmp(tmp_path)
    (tmp_path / ring.NAMES[4]).with_suffix(".xmp").write_text(
        (tmp_path / ring.NAMES[4]).with_suffix(".xmp").read_text().replace("Position", "Elsewhere")
    )
    (tmp_path / ring.NAMES[5]).with_suffix(".xmp").unlink()
    scene = load_scene(tmp_path)
    assert len(scene.views) == ring.COUNT - 2
    assert any("does not list 2 image(s)" in text for text in scene.warnings)


def test_xmp_files_named_after_the_whole_file(tmp_path: Path) -> None:
    survey_files.write_xmp(tmp_path)
    for path in sorted(tmp_path.glob("*.xmp")):
        path.rename(path.with_suffix(".png.xmp"))
    assert [view.name for view in load_scene(tmp_path).views] == ring.NAMES


def test_a_large_xmp_file_is_refused(tmp_path: Path) -> None:
    path = survey_files.write_xmp(tmp_path) / "view07.xmp"
    path.write_text(path.read_text() + " " * MAX_XMP_BYTES)
    refuses("view07.xmp: has more than 1 MiB, expected RealityScan's XMP file", load_scene, tmp_path)


def test_two_xmp_files_of_one_photograph_are_one_line(tmp_path: Path) -> None:
    survey_files.write_xmp(tmp_path)
    (tmp_path / "view03.png.xmp").write_text((tmp_path / "view03.xmp").read_text())
    refuses("lists view03.png twice, expected each photograph once", load_scene, tmp_path)


def test_a_cloud_above_the_photographs_is_not_theirs(tmp_path: Path) -> None:
    folder = survey_files.write_xmp(tmp_path / "photos")
    ring.write_cloud(tmp_path / "points3D.ply", *ring.points())
    assert not len(load_scene(folder).points)
    (tmp_path / "points3D.ply").rename(folder / "points3D.ply")
    assert len(load_scene(folder).points) == len(ring.points()[0])


def test_a_mask_beside_a_photograph_is_not_the_photograph(tmp_path: Path) -> None:
    names = [f"{name[:-4]}.exr" for name in ring.NAMES]  # a file type that sorts before the masks
    survey_files.write_xmp(tmp_path, names=names)
    ring.write_pictures(tmp_path, ring.NAMES[:2], (ring.WIDTH // 2, ring.HEIGHT // 2))
    scene = load_scene(tmp_path)
    assert [view.path.suffix for view in scene.views] == [".exr"] * ring.COUNT
    assert {view.lens.width for view in scene.views} == {ring.WIDTH}


def test_xmp_files_of_editors_are_no_cameras(tmp_path: Path) -> None:
    """Lightroom's: the folder is one of photographs."""
    ring.write_pictures(tmp_path, ["a.png", "b.png"])
    (tmp_path / "a.xmp").write_text('<x:xmpmeta xmlns:x="adobe:ns:meta/"/>')
    assert detect(tmp_path) == "photos"


def test_xmp_files_apart_from_their_photographs(tmp_path: Path) -> None:
    folder = survey_files.write_xmp(tmp_path / "photos" / "..")
    (tmp_path / "poses").mkdir()
    for path in sorted(folder.glob("*.xmp")):
        path.rename(tmp_path / "poses" / path.name)
    told = refusal(lambda: load_scene(tmp_path / "poses"))
    assert "has no photograph of the 20 XMP files" in told
    assert "another project" in told
    assert len(load_scene(tmp_path / "poses", images="..").views) == ring.COUNT
    refuses("no such folder, expected the photographs of", load_scene, tmp_path / "poses", images="photos")


def test_xmp_files_of_another_project(tmp_path: Path) -> None:
    """A few more than there are photographs are left out, many are refused."""
    survey_files.write_xmp(tmp_path)
    text = (tmp_path / "view00.xmp").read_text()
    (tmp_path / "other00.xmp").write_text(text)
    scene = load_scene(tmp_path)
    assert any("lists 1 image(s) that are missing" in told for told in scene.warnings)
    for index in range(1, 6):
        (tmp_path / f"other{index:02}.xmp").write_text(text)
    refuses("lists 6 image.s. that are missing", load_scene, tmp_path)


def test_xmp_files_of_two_coordinate_systems_are_refused(tmp_path: Path) -> None:
    survey_files.write_xmp(tmp_path)
    path = tmp_path / "view07.xmp"
    path.write_text(path.read_text().replace('Type="3"', 'Type="1"'))
    told = refusal(lambda: load_scene(tmp_path))
    assert (
        "its XMP files have 2 coordinate systems (xcr:ExportCoordinateSystemType '3' of view00, '1' of view07)" in told
    )


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("<xcr:Position>", "<xcr:Position>x ", "xcr:Position is 'x .* expected 3 numbers"),
        ("<xcr:Rotation>", "<xcr:Rotation>0 ", "xcr:Rotation is .* expected 9 numbers"),
        ("<xcr:Rotation>", "<xcr:Rotation>1 0 0 0 1 0 0 0 -1</xcr:Rotation><xcr:Rotation>", "is no rotation"),
        ("FocalLength35mm", "Other", "has no xcr:FocalLength35mm, expected a number"),
        ('"absolute"', '"relative"', "xcr:Coordinates is 'relative', expected absolute"),
        ('AspectRatio="1"', 'AspectRatio="1" xcr:Skew="0.1"', "xcr:Skew is 0.1, expected 0"),
        ('"0 0 0 0 0 0"', '".1 0 0 0 0 0"', ""),
        (
            '"perspective" xcr:DistortionCoeficients="0',
            '"division" xcr:DistortionCoeficients=".1',
            "xcr:DistortionModel 'division', expected perspective, brown3, brown3t2, brown4, brown4t2;",
        ),
        (
            '"perspective" xcr:DistortionCoeficients="0 0 0 0',
            '"brown4" xcr:DistortionCoeficients="0 0 0 .4',
            "k4 = 0.4",
        ),
        ("</x:xmpmeta>", "", "is not readable XML"),
    ],
)
def test_a_wrong_xmp_file_is_one_line(tmp_path: Path, old: str, new: str, told: str) -> None:
    path = survey_files.write_xmp(tmp_path) / "view07.xmp"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    if told:
        refuses(f"view07.xmp: .*{told}", load_scene, tmp_path)
    else:
        assert load_scene(tmp_path).views[7].lens.is_pinhole  # coefficients without a distortion model do not count
