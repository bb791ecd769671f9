# SPDX-License-Identifier: Apache-2.0
"""Cameras as survey programs write them: OpenSfM's reconstruction.json, Metashape's XML, RealityScan's XMP."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import ring
from scipy.spatial.transform import Rotation

from clsplat.arrays import Float64

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
    **keys: Any,
) -> Path:
    """Write a reconstruction.json with pictures in images/. Returns its path.

    posed: poses; the ring's by default.
    camera: keys that replace those of the camera.
    offset: (3,), added to the points.
    keys: further keys of the reconstruction.
    """
    ring.write_pictures(folder / "images", names)
    longer = max(ring.WIDTH, ring.HEIGHT)
    lens = {"projection_type": "perspective", "width": ring.WIDTH, "height": ring.HEIGHT}
    shots = {
        name: {
            "camera": "v2 a",
            "rotation": Rotation.from_matrix(rotation).as_rotvec().tolist(),
            "translation": translation.tolist(),
        }
        for name, (rotation, translation) in zip(names, posed or ring.poses(), strict=True)
    }
    xyz, rgb = ring.points()
    xyz = xyz if offset is None else xyz + offset
    points = {
        str(index): {"coordinates": place, "color": colour}
        for index, (place, colour) in enumerate(zip(xyz.tolist(), rgb.astype(float).tolist(), strict=True))
    }
    of_file = {"focal": ring.FOCAL / longer, "k1": 0.0, "k2": 0.0} if camera is None else camera
    part = {"cameras": {"v2 a": {**lens, **of_file}}, "shots": shots, "points": points, **keys}
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
    calibration: str = f"<f>{ring.FOCAL}</f><cx>0</cx><cy>0</cy>",
    kind: str = "frame",
) -> Path:
    """Write cameras.xml with pictures in images/. Returns its path.

    names: names of the pictures' files. The labels are these names without their extension.
    world_from_chunk: (4, 4), similarity of the component; none by default.
    reference: the chunk's coordinate system as WKT.
    calibration: elements of the calibration.
    kind: type of the sensor.
    """
    ring.write_pictures(folder / "images", names)
    move = np.eye(4) if world_from_chunk is None else world_from_chunk
    scale = np.cbrt(np.linalg.det(move[:3, :3]))
    turn = move[:3, :3] / scale
    cameras = []
    for index, (name, pose) in enumerate(zip(names, posed or ring.poses(), strict=True)):
        matrix = np.eye(4)
        matrix[:3, :3] = turn.T @ pose[0].T
        matrix[:3, 3] = turn.T @ (ring.centre_of(pose) - move[:3, 3]) / scale
        text = " ".join(map(repr, matrix.ravel().tolist()))
        cameras.append(
            f'<camera id="{index}" sensor_id="0" component_id="0" label="{Path(name).stem}">'
            f"<transform>{text}</transform><orientation>1</orientation></camera>"
        )
    parts = zip(("rotation", "translation", "scale"), (turn, move[:3, 3], np.array(scale)), strict=True)
    transform = "".join(f"<{part}>{' '.join(map(repr, value.ravel().tolist()))}</{part}>" for part, value in parts)
    sides = f'<resolution width="{ring.WIDTH}" height="{ring.HEIGHT}"/>'
    path = folder / "cameras.xml"
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0">\n<chunk label="Chunk 1" enabled="true">'
        f'<sensors next_id="1"><sensor id="0" label="a" type="{kind}">{sides}'
        f'<calibration type="{kind}" class="adjusted">{sides}{calibration}</calibration></sensor></sensors>\n'
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
) -> Path:
    """Write pictures with RealityScan's XMP files beside them. Returns the folder.

    attributes: attributes of the distortion, and others.
    more: elements after those of the pose.
    """
    ring.write_pictures(folder, names)
    for name, pose in zip(names, posed or ring.poses(), strict=True):
        rotation, position = (" ".join(map(repr, each.ravel().tolist())) for each in (pose[0], ring.centre_of(pose)))
        focal = 36 * ring.FOCAL / max(ring.WIDTH, ring.HEIGHT)
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
