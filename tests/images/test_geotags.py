# SPDX-License-Identifier: Apache-2.0
"""Positions and gravity in photographs' metadata, in files that the tests write."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from camera_files import EXIF_IFD, write_heic

from clsplat.images.geotags import GpsPosition, gps_of, gravity_of


def photograph(path: Path, **attributes: Any) -> Path:
    """A small JPEG with EXIF. attributes: by OpenImageIO's names, with "__" in place of ":"."""
    spec = oiio.ImageSpec(16, 12, 3, "uint8")
    for name, value in attributes.items():
        key = name.replace("__", ":")
        if isinstance(value, tuple):
            spec.attribute(key, oiio.TypeDesc(f"float[{len(value)}]"), value)
        else:
            spec.attribute(key, value)
    image = oiio.ImageBuf(spec)
    assert image.write(str(path)), image.geterror()
    return path


HERE = {
    "GPS__LatitudeRef": "S", "GPS__Latitude": (30.0, 15.0, 36.0), "GPS__LongitudeRef": "W",
    "GPS__Longitude": (98.0, 5.0, 24.0), "GPS__AltitudeRef": 0, "GPS__Altitude": 317.5,
}  # fmt: skip


def test_a_position(tmp_path: Path) -> None:
    found = gps_of(photograph(tmp_path / "a.jpg", **HERE))
    assert found is not None
    assert found.latitude == pytest.approx(-30.26, abs=1e-5)  # OpenImageIO keeps float32
    assert found.longitude == pytest.approx(-98.09, abs=1e-5)
    assert found.altitude == pytest.approx(317.5, abs=1e-3)


@pytest.mark.parametrize(
    "change",
    [
        {"GPS__Status": "V"},
        {"GPS__Latitude": (91.0, 0.0, 0.0)},
        {"GPS__Longitude": (181.0, 0.0, 0.0)},
        {"GPS__Latitude": (0.0, 0.0, 0.0), "GPS__Longitude": (0.0, 0.0, 0.0)},
    ],
)
def test_what_is_no_position(change: dict[str, Any], tmp_path: Path) -> None:
    assert gps_of(photograph(tmp_path / "a.jpg", **{**HERE, **change})) is None


def test_no_altitude_and_no_file(tmp_path: Path) -> None:
    without = {name: value for name, value in HERE.items() if "Altitude" not in name}
    found = gps_of(photograph(tmp_path / "a.jpg", **without))
    assert isinstance(found, GpsPosition)
    assert found.altitude is None
    assert gps_of(photograph(tmp_path / "b.jpg")) is None
    assert gps_of(tmp_path / "none.jpg") is None
    (tmp_path / "text.jpg").write_text("GPS")
    assert gps_of(tmp_path / "text.jpg") is None


def note(vector: tuple[float, float, float], *, tag: int = 8, kind: int = 10, count: int = 3) -> bytes:
    """Apple's maker note with an accelerometer's vector, which begins the 36 bytes after the first entry."""
    numbers = b"".join(struct.pack(">ii", round(value * 1000), 1000) for value in vector)
    return b"Apple iOS\0\0\1MM" + struct.pack(">H", 1) + struct.pack(">HHII", tag, kind, count, 32) + bytes(4) + numbers


def with_note(path: Path, data: bytes, orientation: int = 1) -> Path:
    """A JPEG with a maker note in an APP segment after its header."""
    photograph(path, Orientation=orientation)
    jpeg = path.read_bytes()
    path.write_bytes(jpeg[:2] + b"\xff\xe5" + struct.pack(">H", len(data) + 2) + data + jpeg[2:])
    return path


UPRIGHT = {1: (-1, 0, 0), 3: (1, 0, 0), 6: (0, -1, 0), 8: (0, 1, 0)}
"""Gravity in CoreMotion's axes (x right, y to the top, z out of the screen) of a level phone, by the EXIF orientation
that it writes: 1 with the top on the left, 6 held upright."""


@pytest.mark.parametrize("orientation", UPRIGHT)
def test_gravity_of_a_phone_points_down_in_the_upright_picture(orientation: int, tmp_path: Path) -> None:
    file = with_note(tmp_path / "a.jpg", note(UPRIGHT[orientation]), orientation)  # type: ignore[arg-type]
    np.testing.assert_allclose(gravity_of(file, upright=True), (0, 1, 0), atol=1e-12)
    stored = gravity_of(file, upright=False)
    assert stored is not None
    # the orientation turns the stored picture's down to the upright picture's: 6 by 90 degrees clockwise
    down = {1: (0, 1, 0), 3: (0, -1, 0), 6: (1, 0, 0), 8: (-1, 0, 0)}[orientation]
    np.testing.assert_allclose(stored, down, atol=1e-12)


@pytest.mark.parametrize("orientation", UPRIGHT)
def test_gravity_of_a_phones_heic_points_down(orientation: int, tmp_path: Path) -> None:
    """The decoder turns HEIC upright, so that both kinds of axes are those of the upright picture."""
    from PIL import Image

    record = Image.Exif()
    record[0x112] = orientation
    record.get_ifd(EXIF_IFD)[0x927C] = note(UPRIGHT[orientation])  # type: ignore[arg-type]  # Apple's maker note
    file = write_heic(tmp_path / "a.heic", np.full((48, 64, 3), 128, np.uint8), record.tobytes())
    for upright in (True, False):
        np.testing.assert_allclose(gravity_of(file, upright=upright), (0, 1, 0), atol=1e-12)


def test_a_phone_that_looks_down_has_gravity_ahead(tmp_path: Path) -> None:
    file = with_note(tmp_path / "a.jpg", note((0, -0.6, -0.8)), 6)  # the screen faces up a little
    np.testing.assert_allclose(gravity_of(file, upright=True), (0, 0.6, 0.8), atol=1e-12)


@pytest.mark.parametrize(
    "data",
    [
        note((0, -2, 0)),  # shaken
        note((0, 0, 0)),
        note((0, -1, 0), tag=9),
        note((0, -1, 0), kind=5),
        note((0, -1, 0))[:40],
        b"Apple iOS\0\0\1MM",
        note((0, -1, 0)).replace(struct.pack(">i", 1000), bytes(4)),  # over zero
    ],
)
def test_a_note_without_gravity(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(photograph(tmp_path / "b.jpg").read_bytes() + data)
    assert gravity_of(tmp_path / "a.jpg", upright=True) is None


@pytest.mark.parametrize(("pitch", "roll", "expected"), [
    ("-90.00", "+0.00", (0, 0, 1)), ("-30.00", "0", (0, 0.75**0.5, 0.5)), ("+0.0", "+90.00", (1, 0, 0)),
])  # fmt: skip
def test_gravity_of_a_drones_gimbal(pitch: str, roll: str, expected: tuple[float, ...], tmp_path: Path) -> None:
    xmp = f'<rdf:Description drone-dji:GimbalRollDegree="{roll}" drone-dji:GimbalPitchDegree="{pitch}"/>'
    file = with_note(tmp_path / "a.jpg", xmp.encode())
    np.testing.assert_allclose(gravity_of(file, upright=True), expected, atol=1e-9)
    assert gravity_of(tmp_path / "none.jpg", upright=True) is None
