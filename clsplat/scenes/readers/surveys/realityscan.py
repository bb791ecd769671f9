# SPDX-License-Identifier: Apache-2.0
"""Reading of the XMP files that RealityScan (RealityCapture) writes beside photographs.

Format: "RealityCapture XMP Camera Math" and RealityScan Help, "XMP Metadata Export". `Rotation` is the rotation of
`cam_from_world` by rows in our axes, and `Position` the camera's centre. Lengths in pictures are fractions of the
longer side, from the middle; `FocalLength35mm` is 36 times the focal length in this unit. The coefficients are k1 to
k4, t1, t2. Here t1 and t2 are in the reverse of OpenCV's order, as RealityScan's own OpenCV-compliant export shows.

The size of a photograph is not in its XMP file, but in the photograph's header.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from clsplat.arrays import Float64
from clsplat.errors import InputError, examples
from clsplat.files.documents import open_input
from clsplat.files.xml_documents import read_xml
from clsplat.images.reading import find_images, image_size
from clsplat.scenes.camera_json import short
from clsplat.scenes.dataset import DataSet, Lens, PosedImage
from clsplat.scenes.photo_files import by_label
from clsplat.scenes.readers.surveys.lenses import UNDISTORTED_ADVICE, SurveyLens, model_of_kind
from clsplat.scenes.readers.surveys.values import numbers_in

XCR = "{http://www.capturingreality.com/ns/xcr/1.1#}"
"""Namespace of RealityScan's values."""
XCR_BYTES = XCR[1:-1].encode()
"""The namespace as it stands in a file."""
DESCRIPTION = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}Description"
"""Name of the XMP element that has the values as attributes or as elements."""
MAX_XMP_BYTES = 1 << 20
"""Largest size of an XMP file in bytes. RealityScan's have about 2 KB. All files of a folder are kept in memory."""
EXPECTED_XMP = "RealityScan's XMP file"
XMP_FILES = "a folder of photographs with RealityScan's XMP files"
FRAME_WIDTH_MM = 36.0
"""Width of a picture on 35 mm film, to which `FocalLength35mm` refers."""
BROWN_MODEL = re.compile(r"brown(\d)(t2)?")
"""Pattern of each `DistortionModel` that has coefficients: the number of radial ones, and t2 if t1 and t2 are used."""
XMP_ROTATION_SLACK = 1e-3
"""Largest deviation of `Rotation` from a rotation. Files have 15 digits; edited ones fewer."""
XMP_PATTERN = "*.[xX][mM][pP]"


def find_xmp(folder: Path) -> Path | None:
    """Return the folder if it or its sub-folders have an XMP file with a camera's pose; None otherwise."""
    return folder if any(_has_pose(path) for path in _sidecars(folder)) else None


def read_xmp(folder: Path, photographs: Path | None) -> DataSet:
    """Read the XMP files of a folder. The images have no paths, and there are no points.

    photographs: folder of photographs with the XMP files' names; None if they are beside the XMP files.
    XMP files without a pose are left out: RealityScan has not aligned their photographs. Raises InputError that
    names the file for invalid XML and values, files of different coordinate systems, and unsupported lenses. Also
    raises it if no XMP file has a photograph.
    """
    cameras = [_Xmp(folder, path) for path in _sidecars(folder) if _has_pose(path)]
    _check_one_system(folder, cameras)
    there = photographs or folder
    present = find_images(there)
    files = {path.relative_to(there).as_posix(): path for path in present}  # IMG.jpg.xmp, then IMG.xmp
    files |= by_label(there, present)
    sizes = {camera.name: image_size(files[camera.name], orient=False) for camera in cameras if camera.name in files}
    if not sizes:
        names = examples(camera.name for camera in cameras)
        raise InputError(
            f"{there}: has no photograph of the {len(cameras):,} XMP files of {folder} ({names}), expected photographs "
            "with these names; copy the XMP files to their photographs, or remove them if they are of another project"
        )
    # A missing photograph is left out later, or found under another name. Until then it has the most frequent size.
    ((usual, _),) = Counter(sizes.values()).most_common(1)
    return DataSet([camera.image(*sizes.get(camera.name, usual)) for camera in cameras])


def _sidecars(folder: Path) -> list[Path]:
    found = sorted(folder.rglob(XMP_PATTERN))
    return [path for path in found if not any(part.startswith(".") for part in path.relative_to(folder).parts)]


def _has_pose(path: Path) -> bool:
    if not path.is_file():
        return False
    with open_input(path, EXPECTED_XMP) as file:
        data = file.read(MAX_XMP_BYTES)
    return XCR_BYTES in data and b"Position" in data and b"Rotation" in data


@dataclass(frozen=True)
class _Xmp:
    """An XMP file. folder: the folder to which the photograph's name is relative."""

    folder: Path
    path: Path

    @property
    def name(self) -> str:
        """Name of the photograph, usually without its extension, with sub-folders."""
        return self.path.relative_to(self.folder).with_suffix("").as_posix()

    @cached_property
    def _elements(self) -> list[Element]:
        root = read_xml(self.path, EXPECTED_XMP, MAX_XMP_BYTES)
        return [each for each in root.iter() if each.tag in (DESCRIPTION, "Description")]

    def text(self, key: str) -> str | None:
        """Return a value as text, from an attribute or an element; None if there is none."""
        for element in self._elements:
            found = element.get(XCR + key)
            if found is None:
                found = element.findtext(XCR + key)
            if found is not None:
                return found.strip()
        return None

    def numbers(self, key: str, count: int, default: float | None = None) -> Float64:
        """Return the numbers (count,) of a value. default: each number of a missing value; None to refuse it."""
        text = self.text(key)
        if text is None and default is not None:
            return np.full(count, default)
        values = numbers_in(text or "", count)
        if values is None:
            found = f"has no xcr:{key}" if text is None else f"xcr:{key} is {short(text)}"
            numbers = "a number" if count == 1 else f"{count} numbers"
            raise InputError(f"{self.path}: {found}, expected {numbers}; export the XMP files again")
        return values

    def image(self, width: int, height: int) -> PosedImage:
        """Return the image of a photograph of this size in pixels."""
        if (kind := self.text("Coordinates") or "absolute") != "absolute":
            raise InputError(
                f"{self.path}: xcr:Coordinates is {short(kind)}, expected absolute, as a position in a rig is not one "
                "in the scene; export the XMP files without rigs"
            )
        u, _, v = np.linalg.svd(given := self.numbers("Rotation", 9).reshape(3, 3))
        rotation = np.asarray(u @ v, np.float64)
        if np.linalg.det(rotation) < 0 or np.abs(given - rotation).max() > XMP_ROTATION_SLACK:
            raise InputError(f"{self.path}: xcr:Rotation is no rotation, expected one; export the XMP files again")
        return PosedImage(self.name, self.lens(width, height), rotation, -rotation @ self.numbers("Position", 3))

    def lens(self, width: int, height: int) -> Lens:
        """Return the lens at a photograph's size in pixels."""
        where = str(self.path)
        kind = self.text("DistortionModel") or ""
        coefficients = self.numbers("DistortionCoeficients", 6, 0.0)  # sic
        if coefficients.any():
            model_of_kind("realityscan", kind, where, "xcr:DistortionModel ")
        if skew := float(self.numbers("Skew", 1, 0.0)[0]):
            raise InputError(
                f"{where}: xcr:Skew is {skew:g}, expected 0, as no lens model here has a skew; {UNDISTORTED_ADVICE}, "
                "or align without skew"
            )
        longer = max(width, height)
        focal = longer * float(self.numbers("FocalLength35mm", 1)[0]) / FRAME_WIDTH_MM
        aspect, x, y = (
            float(self.numbers(key, 1, value)[0])
            for key, value in (("AspectRatio", 1.0), ("PrincipalPointU", 0.0), ("PrincipalPointV", 0.0))
        )
        brown = BROWN_MODEL.fullmatch(kind)
        used = np.arange(6) < (int(brown[1]) if brown else 0)
        used[4:] = bool(brown and brown[2])
        k1, k2, k3, k4, t1, t2 = np.where(used, coefficients, 0.0).tolist()
        centre = (width / 2 + longer * x, height / 2 + longer * y)
        return SurveyLens(width, height, (focal, focal * aspect), centre, (k1, k2, k3, k4), (t2, t1)).lens(where)


def _check_one_system(folder: Path, cameras: list[_Xmp]) -> None:
    """Raise InputError if the XMP files have different coordinate systems or are of different components."""
    for key, what in (("ExportCoordinateSystemType", "coordinate systems"), ("ComponentId", "components")):
        by_value: dict[str | None, str] = {}
        for camera in cameras:
            by_value.setdefault(camera.text(key), camera.name)
        if len(by_value) > 1:
            named = examples(f"{short(value)} of {name}" for value, name in by_value.items())
            raise InputError(
                f"{folder}: its XMP files have {len(by_value)} {what} (xcr:{key} {named}), expected one; export the "
                "XMP files of one component again and remove the others"
            )
