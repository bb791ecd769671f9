# SPDX-License-Identifier: Apache-2.0
"""Cameras as survey programs write them: OpenSfM's reconstruction.json, Metashape's XML, RealityScan's XMP."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import ring
from scipy.spatial.transform import Rotation

from clsplat.arrays import Float64


@dataclass(frozen=True)
class Optics:
    """A pinhole lens in pixels, with the principal point in the middle."""

    width: int = ring.WIDTH
    height: int = ring.HEIGHT
    focal: float = ring.FOCAL

    @property
    def longer(self) -> int:
        return max(self.width, self.height)


RING = Optics()
UTM_OFFSET = np.array([512345.5, 5412345.25, 431.125])
"""East, north and height of a place in a UTM zone."""


def at(offset: Float64 = UTM_OFFSET) -> list[ring.Pose]:
    """The ring's poses in a world whose origin is moved to `offset`."""
    return [ring.moved(pose, ring.centre_of(pose) + offset) for pose in ring.poses()]


def write_opensfm(
    folder: Path,
    posed: Sequence[ring.Pose] | None = None,
    names: Sequence[str] = ring.NAMES,
    *,
    camera: Mapping[str, Any] | None = None,
    offset: Float64 | None = None,
    optics: Sequence[Optics] | None = None,
    cloud: tuple[Float64, np.ndarray] | None = None,
    **keys: Any,
) -> Path:
    """Write a reconstruction.json, with the ring's pictures in images/ unless `optics` is given. Returns its path.

    posed: poses; the ring's by default.
    camera: keys that replace those of the camera.
    offset: (3,), added to the points.
    cloud: points (N, 3) and their colours (N, 3), 0 to 255; the ring's by default.
    keys: further keys of the reconstruction.
    """
    if optics is None:
        ring.write_pictures(folder / "images", names)
    optics = optics or [RING] * len(names)
    kinds = list(dict.fromkeys(optics))
    usual = {"projection_type": "perspective"}
    lenses = {
        f"v2 {index}": {
            **usual,
            "width": lens.width,
            "height": lens.height,
            **({"focal": lens.focal / lens.longer, "k1": 0.0, "k2": 0.0} if camera is None else camera),
        }
        for index, lens in enumerate(kinds)
    }
    shots = {
        name: {
            "camera": f"v2 {kinds.index(lens)}",
            "rotation": Rotation.from_matrix(rotation).as_rotvec().tolist(),
            "translation": translation.tolist(),
        }
        for name, (rotation, translation), lens in zip(names, posed or ring.poses(), optics, strict=True)
    }
    xyz, rgb = ring.points() if cloud is None else cloud
    xyz = xyz if offset is None else xyz + offset
    points = {
        str(index): {"coordinates": place, "color": colour}
        for index, (place, colour) in enumerate(zip(xyz.tolist(), rgb.astype(float).tolist(), strict=True))
    }
    part = {"cameras": lenses, "shots": shots, "points": points, **keys}
    path = folder / "reconstruction.json"
    path.write_text(json.dumps([part]))
    return path


def write_metashape(
    folder: Path,
    posed: Sequence[ring.Pose] | None = None,
    names: Sequence[str] = ring.NAMES,
    *,
    world_from_chunk: Float64 | None = None,
    reference: str = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1]]',
    calibration: str = "",
    kind: str = "frame",
    optics: Sequence[Optics] | None = None,
) -> Path:
    """Write cameras.xml, with the ring's pictures in images/ unless `optics` is given. Returns its path.

    names: names of the pictures' files. The labels are these names without their extension.
    world_from_chunk: (4, 4), similarity of the component; none by default.
    reference: the chunk's coordinate system as WKT.
    calibration: elements of every calibration; by default those of `optics`.
    optics: lens of each photograph; the ring's by default.
    kind: type of the sensor.
    """
    if optics is None:
        ring.write_pictures(folder / "images", names)
    optics = optics or [RING] * len(names)
    kinds = list(dict.fromkeys(optics))
    move = np.eye(4) if world_from_chunk is None else world_from_chunk
    scale = np.cbrt(np.linalg.det(move[:3, :3]))
    turn = move[:3, :3] / scale
    cameras = []
    for index, (name, pose, lens) in enumerate(zip(names, posed or ring.poses(), optics, strict=True)):
        matrix = np.eye(4)
        matrix[:3, :3] = turn.T @ pose[0].T
        matrix[:3, 3] = turn.T @ (ring.centre_of(pose) - move[:3, 3]) / scale
        text = " ".join(map(repr, matrix.ravel().tolist()))
        cameras.append(
            f'<camera id="{index}" sensor_id="{kinds.index(lens)}" component_id="0" label="{Path(name).stem}">'
            f"<transform>{text}</transform><orientation>1</orientation></camera>"
        )
    parts = zip(("rotation", "translation", "scale"), (turn, move[:3, 3], np.array(scale)), strict=True)
    transform = "".join(f"<{part}>{' '.join(map(repr, value.ravel().tolist()))}</{part}>" for part, value in parts)
    sensors = []
    for index, lens in enumerate(kinds):
        sides = f'<resolution width="{lens.width}" height="{lens.height}"/>'
        values = calibration or f"<f>{lens.focal!r}</f><cx>0</cx><cy>0</cy>"
        sensors.append(
            f'<sensor id="{index}" label="a" type="{kind}">{sides}'
            f'<calibration type="{kind}" class="adjusted">{sides}{values}</calibration></sensor>'
        )
    path = folder / "cameras.xml"
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0">\n<chunk label="Chunk 1" enabled="true">'
        f'<sensors next_id="1">{"".join(sensors)}</sensors>\n'
        f'<components><component id="0" label="a"><transform>{transform}</transform></component></components>\n'
        f'<cameras><group id="0" label="Group 1" type="folder">{"".join(cameras[:5])}</group>{"".join(cameras[5:])}'
        f"</cameras>\n<reference>{reference}</reference>\n</chunk>\n</document>\n"
    )
    return path


def chunk_at(offset: Float64 = UTM_OFFSET) -> Float64:
    """A similarity (4, 4) from a chunk with another scale and other axes to a world at `offset`."""
    move = np.eye(4)
    move[:3, :3] = 12.5 * Rotation.from_euler("xyz", [30, -50, 70], degrees=True).as_matrix()
    move[:3, 3] = offset
    return move


def write_xmp(
    folder: Path,
    posed: Sequence[ring.Pose] | None = None,
    names: Sequence[str] = ring.NAMES,
    *,
    attributes: str = 'xcr:DistortionModel="perspective" xcr:DistortionCoeficients="0 0 0 0 0 0"',
    more: str = "",
    optics: Sequence[Optics] | None = None,
) -> Path:
    """Write RealityScan's XMP files, beside the ring's pictures unless `optics` is given. Returns the folder.

    attributes: attributes of the distortion, and others.
    more: elements after those of the pose.
    """
    if optics is None:
        ring.write_pictures(folder, names)
    optics = optics or [RING] * len(names)
    for name, pose, lens in zip(names, posed or ring.poses(), optics, strict=True):
        focal = 36 * lens.focal / lens.longer
        rotation, position = (" ".join(map(repr, each.ravel().tolist())) for each in (pose[0], ring.centre_of(pose)))
        (folder / name).with_suffix(".xmp").write_text(
            '<x:xmpmeta xmlns:x="adobe:ns:meta/">\n  <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
            '    <rdf:Description xcr:Version="4" xcr:ExportCoordinateSystemType="3" xcr:PosePrior="initial"\n'
            f'       xcr:Coordinates="absolute" {attributes} xcr:FocalLength35mm="{focal!r}"\n'
            '       xcr:AspectRatio="1" xcr:PrincipalPointU="0" xcr:PrincipalPointV="0"\n'
            '       xcr:CalibrationGroup="-1" xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">\n'
            f"      <xcr:Rotation>{rotation}</xcr:Rotation>\n      <xcr:Position>{position}</xcr:Position>{more}\n"
            "    </rdf:Description>\n  </rdf:RDF>\n</x:xmpmeta>\n"
        )
    return folder
