# SPDX-License-Identifier: Apache-2.0
"""Scene record of a run, scene.json: name, size and camera of each view, and a digest of each photograph."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.errors import InputError, examples, warn
from clsplat.files.atomic import atomic_write
from clsplat.files.documents import parse_json, read_document, short_digest
from clsplat.runs.checkpoints import scene_of
from clsplat.scenes.geography.georeference import GEOREFERENCE_FILE
from clsplat.scenes.orientation.frame_record import FRAME_RECORD_FILE
from clsplat.version import package_version

if TYPE_CHECKING:
    from clsplat.runs.run import Run
    from clsplat.scenes.scene import Scene, View

SCENE_RECORD_FILE_NAME = "scene.json"
MAX_SCENE_RECORD_BYTES = 256 << 20
"""Size limit of scene.json in bytes, enough for some hundred thousand views."""
CAMERA_RELATIVE_TOLERANCE = 1e-6
"""Relative difference up to which camera parameters count as equal, because versions may round differently."""
ONE_PLACE_SPREAD = 1e-12
"""Recorded cameras are in one place if none is farther from their middle than this fraction of their largest
coordinate."""
_EXPECTED_SCENE_RECORD = "the record of a run's scene"


def record_of(scene: Scene, resolution: int) -> dict[str, Any]:
    """Return the content of scene.json. Reads every photograph whose digest is not known yet.

    resolution: value of the setting `resolution`.
    """
    points = hashlib.blake2b(np.ascontiguousarray(scene.points, "<f8").tobytes(), digest_size=16)
    points.update(np.ascontiguousarray(scene.point_colors, "<f4").tobytes())
    digests = scene.digests
    return {
        "clsplat": package_version(),
        "resolution": resolution,
        "origin": scene.origin.tolist(),
        "points": {"count": len(scene.points), "blake2b": points.hexdigest()},
        "views": {view.name: _view(view, digests[view.name]) for view in scene.views},
        **({"length_unit": scene.length_unit} if scene.unit_differs else {}),
    }


def _view(view: View, digest: str | None) -> dict[str, Any]:
    camera = view.camera
    bent = {"projection": camera.projection, "radial": [float(value) for value in camera.radial]}
    return {
        "split": view.split,
        "file": view.path.name,
        "folder": view.path.parent.name,
        "blake2b": digest,
        "size": [camera.width, camera.height],
        "lens": [float(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy)],
        "pose": [float(value) for value in (*np.ravel(camera.rotation), *camera.translation)],
        **(bent if not camera.is_pinhole else {}),
    }


def digest_of(record: dict[str, Any]) -> str:
    """Return the digest of a recorded scene, 32 hexadecimal digits. It does not depend on clsplat's version."""
    scene = {key: value for key, value in record.items() if key not in ("clsplat", "earlier", "length_unit")}
    return hashlib.sha256(json.dumps(scene, sort_keys=True).encode()).hexdigest()[:32]


def known_digests(record: dict[str, Any] | None) -> set[str]:
    """Return the digests of a recorded scene and of the run's earlier scenes; empty without a record."""
    return {digest_of(record), *record.get("earlier", [])} if record is not None else set()


def write(run: Run, scene: Scene) -> None:
    """Write scene.json. Checkpoints of an earlier scene stay valid, because the record lists earlier scenes."""
    record, there = record_of(scene, run.config.resolution), {scene_of(file) for _, file in run.checkpoints()}
    earlier = known_digests(read(run)) | {digest for digest in there if digest}
    record["earlier"] = sorted(earlier - {digest_of(record)})
    atomic_write(run.path / SCENE_RECORD_FILE_NAME, (json.dumps(record, allow_nan=False) + "\n").encode())


def read(run: Run) -> dict[str, Any] | None:
    """Return the content of scene.json; None if it is missing, as in runs of earlier versions. Raises InputError."""
    path = run.path / SCENE_RECORD_FILE_NAME
    if not path.exists():
        return None
    advice = "remove it, and the run resumes without a comparison"
    try:
        record = parse_json(read_document(path, _EXPECTED_SCENE_RECORD, MAX_SCENE_RECORD_BYTES))
        views, points = record["views"], record["points"]
        assert isinstance(views, dict)
        assert isinstance(points["count"], int)
        assert len(record["origin"]) == 3
        assert isinstance(record["resolution"], int)
        assert 0 < float(record.get("length_unit", 1)) < inf
        assert isinstance(record.get("earlier", []), list)
        assert all(isinstance(digest, str) for digest in record.get("earlier", []))
        for view in views.values():
            assert {"split", "file", "folder", "blake2b", "size", "lens", "pose"} <= view.keys()
            assert all(len(np.array(view[key], float)) == n for key, n in (("size", 2), ("lens", 4), ("pose", 12)))
            assert "radial" not in view or ("projection" in view and len(np.array(view["radial"], float)) == 4)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, AssertionError) as error:
        why = str(error) or "its form is wrong"
        raise InputError(f"{path}: is damaged ({why}), expected {_EXPECTED_SCENE_RECORD}; {advice}") from None
    return dict(record)


def length_unit_of(record: dict[str, Any]) -> float | None:
    """Return the length unit in scene.json, with which the training began; None if this was the scene's extent."""
    unit = record.get("length_unit")
    return None if unit is None else float(unit)


def own_cameras(run: Run | None) -> list[Camera]:
    """Return the cameras of a run's training and held-out photographs, sorted by name; empty if not recorded.

    Raises InputError like `read`.
    """
    record = read(run) if run is not None else None
    if record is None:
        return []
    cameras = []
    for _, view in sorted(record["views"].items()):
        (width, height), (fx, fy, cx, cy), pose = view["size"], view["lens"], np.array(view["pose"], np.float64)
        camera = Camera(width, height, fx, fy, cx, cy, pose[:9].reshape(3, 3), pose[9:])
        if "radial" in view:
            camera = replace(camera, projection=view["projection"], radial=tuple(view["radial"]))
        cameras.append(camera)
    return cameras


def differences(earlier: dict[str, Any], now: dict[str, Any], *, moved: bool = False) -> list[str]:
    """Return short descriptions of the differences between two records of a run's scene: the earlier one and now.

    moved: True if the scene was moved from the frame of its files. The files may have been turned or scaled since the
        earlier record, so that the same points are rounded differently. So only the number of points is compared.
    If --resolution has changed, two differences are left out: changed sizes, and changed pixels of a photograph that is
    now read from another file.
    """
    was, new, resized = earlier["views"], now["views"], earlier["resolution"] != now["resolution"]
    held_out = "held out in one and not in the other"
    changed: dict[str, list[str]] = {
        "missing now": [name for name in was if name not in new],
        "new": [name for name in new if name not in was],
        **{what: [] for what in ("with another photograph", "with another camera", "with another size", held_out)},
    }
    both, size = [name for name in was if name in new], _size_of(was)
    for name in both:
        a, b = was[name], new[name]
        same_file = (a["file"], a["folder"]) == (b["file"], b["folder"])
        turned = not _same_pose(a["pose"], b["pose"], size)
        bent = "radial" in a and (a["projection"] != b.get("projection") or not _close(a["radial"], b["radial"]))
        if turned or bent or (a["size"] == b["size"] and not _close(a["lens"], b["lens"])):
            changed["with another camera"].append(name)
        elif a["size"] != b["size"] and not resized:
            changed["with another size"].append(name)
        if a["blake2b"] != b["blake2b"] and (same_file or not resized):
            changed["with another photograph"].append(name)
        if a["split"] != b["split"]:
            changed[held_out].append(name)
    changes = [_listed(what, names) for what, names in changed.items() if names]
    same = earlier["points"]["count"] == now["points"]["count"] if moved else earlier["points"] == now["points"]
    if not same and not changes:
        changes.append(f"other points ({earlier['points']['count']:,} before, {now['points']['count']:,} now)")
    return changes


def check(run: Run, scene: Scene, path: Path, resolution: int, *, accept: bool = False) -> bool:
    """Compare the scene read from `path` with the run's recorded scene. Returns True if they differ.

    resolution: value of the setting `resolution`.
    accept: True to accept differences (--accept-changes). Otherwise they raise InputError.
    Another origin of the world always raises InputError, because the model would be displaced.
    """
    earlier = read(run)
    if earlier is None:
        return False
    known = known_digests(earlier)
    others = [file for _, file in run.checkpoints() if (digest := scene_of(file)) and digest not in known]
    if others and not accept:
        raise InputError(
            f"{others[-1]}: is from a training on another scene than that of {run.path}, expected a checkpoint of "
            "this run; remove it, or go on from it with --accept-changes"
        )
    now = record_of(scene, resolution)
    changes = differences(earlier, now, moved=scene.world_from_files is not None)
    if changes and not accept:
        raise InputError(
            f"{path}: is not the scene that {run.path} began with: {'; '.join(changes)}; expected the same views and "
            "photographs; give --accept-changes to go on with the changed scene"
        )
    if earlier["origin"] != now["origin"]:
        raise InputError(
            f"{path}: has another origin in the world than the scene that {run.path} began with "
            f"({now['origin']}, not {earlier['origin']}), expected the same; start a new run"
        )
    return bool(changes or others)


def keep(run: Run, scene: Scene, *, resuming: bool) -> None:
    """Write scene.json, unless the run is resumed and its scene.json was made at the same --resolution. Warns if a
    resumed run has no scene.json.

    Also writes frame.json, unless the scene has the frame that its cameras had first, and georeference.json if the
    scene's place on the earth is known.
    """
    known = read(run) if resuming else None
    if known is None and resuming and run.checkpoints():
        warn(
            f"{run.path}: has no {SCENE_RECORD_FILE_NAME}, like runs of earlier versions: it is not known whether this "
            "is the scene that it began with; this scene is recorded now"
        )
    if known is None or known["resolution"] != run.config.resolution:
        write(run, scene)
    if not scene.frame.is_source:
        atomic_write(run.path / FRAME_RECORD_FILE, scene.frame.content())
    if scene.georeference is not None:
        atomic_write(run.path / GEOREFERENCE_FILE, scene.georeference.content())


def of_evaluation(run: Run, views: Sequence[View]) -> list[str]:
    """Return the reasons, as texts, why scores of these views do not count as held-out scores of the run's scene."""
    try:
        record = read(run)
    except InputError:
        record = None
    was = record["views"] if record is not None else {}
    known = [view for view in views if view.name in was]
    seen = [view.name for view in known if was[view.name]["split"] == "train"]
    changed = [
        view.name
        for view in known
        if (was[view.name]["file"], was[view.name]["folder"]) == (view.path.name, view.path.parent.name)
        # the first word of "blake2b" is the digest of the photograph's file, without its mask and known depths
        and (was[view.name]["blake2b"] or "").partition(" ")[0] != (short_digest(view.path) or "")
    ]
    size = _size_of(was)
    moved = [
        view.name
        for view in known
        if not _same_pose(was[view.name]["pose"], [*np.ravel(view.camera.rotation), *view.camera.translation], size)
    ]
    reasons = []
    if seen:
        reasons.append(f"{len(seen):,} of {len(views):,} views were trained on ({examples(seen)}): they score too well")
    if changed:
        reasons.append(_listed("with another photograph than in training", changed))
    if moved:
        reasons.append(f"{_listed('with another camera than in training', moved)}: were the cameras recovered again?")
    if was and not known:
        reasons.append(f"none of the views belongs to the scene that {run.path} began with")
    return reasons


def _size_of(views: Mapping[str, dict[str, Any]]) -> float:
    """Return the distance of the farthest recorded camera from the cameras' middle, by which positions are compared.

    Positions far from the world's origin, as in a UTM zone, still differ relative to this distance. If all cameras are
    at one position, the result is its largest coordinate. Without cameras it is 0.
    """
    if not views:
        return 0.0
    centres = np.stack([_centre(view["pose"]) for view in views.values()])
    spread, largest = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()), float(np.abs(centres).max())
    return spread if spread > ONE_PLACE_SPREAD * largest else largest


def _centre(pose: list[float]) -> Float64:
    """Return the position (3,) of a camera with a recorded pose: 9 values of rotation and 3 of translation."""
    return np.asarray(-np.reshape(pose[:9], (3, 3)).T @ np.array(pose[9:], np.float64))


def _same_pose(a: list[float], b: list[float], size: float) -> bool:
    """True if two recorded poses are equal up to rounding. size: as from `_size_of`."""
    apart = float(np.abs(_centre(a) - _centre(b)).max())
    return _close(a[:9], b[:9]) and apart <= CAMERA_RELATIVE_TOLERANCE * size


def _close(a: list[float], b: list[float]) -> bool:
    """True if two vectors differ by at most CAMERA_RELATIVE_TOLERANCE times their largest component's magnitude."""
    one, other = np.array(a), np.array(b)
    return bool(np.abs(one - other).max() <= CAMERA_RELATIVE_TOLERANCE * max(np.abs(one).max(), np.abs(other).max()))


def _listed(what: str, names: list[str]) -> str:
    """Return a text such as "3 views missing now (a.png, b.png, c.png)". what: text after the count."""
    return f"{len(names):,} {'view' if len(names) == 1 else 'views'} {what} ({examples(names)})"
