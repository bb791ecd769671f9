# SPDX-License-Identifier: Apache-2.0
"""The record that a run keeps of its scene, scene.json: names, sizes and cameras of the views, a digest of each
photograph."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import clsplat
from clsplat.camera import Camera
from clsplat.errors import InputError, examples, warn
from clsplat.files import atomic_write, parse_json, read_document, short_digest
from clsplat.runs.checkpoints import scene_of

if TYPE_CHECKING:
    from clsplat.runs.run import Run
    from clsplat.scenes.scene import Scene, View

NAME = "scene.json"
MAX_SCENE = 256 << 20
"""Bytes of scene.json: of some hundred thousand views."""
SAME = 1e-6
"""Relative difference up to which numbers of a camera are the same: another version may round otherwise."""
_EXPECTED = "what a run knows of its scene"


def record_of(scene: Scene, resolution: int) -> dict[str, Any]:
    """Contents of scene.json; resolution: the setting. Reads every photograph, if that has not been done."""
    points = hashlib.blake2b(np.ascontiguousarray(scene.points, "<f8").tobytes(), digest_size=16)
    points.update(np.ascontiguousarray(scene.point_colors, "<f4").tobytes())
    digests = scene.digests
    return {
        "clsplat": clsplat.__version__,
        "resolution": resolution,
        "origin": scene.origin.tolist(),
        "points": {"count": len(scene.points), "blake2b": points.hexdigest()},
        "views": {view.name: _view(view, digests[view.name]) for view in scene.views},
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
        **(bent if camera.projection != "perspective" else {}),
    }


def digest_of(record: dict[str, Any]) -> str:
    """128 bits of SHA-256 of a scene, in hexadecimal, whatever version has written it down."""
    scene = {key: value for key, value in record.items() if key not in ("clsplat", "earlier")}
    return hashlib.sha256(json.dumps(scene, sort_keys=True).encode()).hexdigest()[:32]


def known_digests(record: dict[str, Any] | None) -> set[str]:
    """Digests of the scene of a record, and of those that it has taken the place of."""
    return {digest_of(record), *record.get("earlier", [])} if record is not None else set()


def write(run: Run, scene: Scene) -> None:
    """Write scene.json. Checkpoints that are there stay those of the run: their scenes are kept as earlier ones."""
    record, there = record_of(scene, run.config.resolution), {scene_of(path) for _, path in run.checkpoints()}
    earlier = known_digests(read(run)) | {digest for digest in there if digest}
    record["earlier"] = sorted(earlier - {digest_of(record)})
    atomic_write(run.path / NAME, (json.dumps(record, allow_nan=False) + "\n").encode())


def read(run: Run) -> dict[str, Any] | None:
    """Contents of scene.json; None where there is none, as in runs of earlier versions. Raises InputError."""
    path = run.path / NAME
    if not path.exists():
        return None
    advice = "remove it, and the run resumes without a comparison"
    try:
        record = parse_json(read_document(path, _EXPECTED, MAX_SCENE))
        views, points = record["views"], record["points"]
        assert isinstance(views, dict)
        assert isinstance(points["count"], int)
        assert len(record["origin"]) == 3
        assert isinstance(record["resolution"], int)
        assert isinstance(record.get("earlier", []), list)
        assert all(isinstance(digest, str) for digest in record.get("earlier", []))
        for view in views.values():
            assert {"split", "file", "folder", "blake2b", "size", "lens", "pose"} <= view.keys()
            assert all(len(np.array(view[key], float)) == n for key, n in (("size", 2), ("lens", 4), ("pose", 12)))
            assert "radial" not in view or ("projection" in view and len(np.array(view["radial"], float)) == 4)
    except (ValueError, KeyError, TypeError, AttributeError, AssertionError) as error:
        why = str(error) or "not of its form"
        raise InputError(f"{path}: is damaged ({why}), expected {_EXPECTED}; {advice}") from None
    return dict(record)


def own_cameras(run: Run | None) -> list[Camera]:
    """The cameras of all photographs that a run was trained on or held against, by their names; none where it does not
    know them. Raises InputError as `read`."""
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


def differences(earlier: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Differences between a scene and the one that a run has begun with, in few words each. With another --resolution
    sizes may differ, and files of another size stand in."""
    was, new, resized = earlier["views"], now["views"], earlier["resolution"] != now["resolution"]
    held_out = "held out in one and not in the other"
    changed: dict[str, list[str]] = {
        "not there any more": [name for name in was if name not in new],
        "new": [name for name in new if name not in was],
        **{what: [] for what in ("another photograph", "another camera", "another size", held_out)},
    }
    both = [name for name in was if name in new]
    for name in both:
        a, b = was[name], new[name]
        same_file = (a["file"], a["folder"]) == (b["file"], b["folder"])
        turned = not (_close(a["pose"][:9], b["pose"][:9]) and _close(a["pose"][9:], b["pose"][9:]))
        bent = "radial" in a and (a["projection"] != b.get("projection") or not _close(a["radial"], b["radial"]))
        if turned or bent or (a["size"] == b["size"] and not _close(a["lens"], b["lens"])):
            changed["another camera"].append(name)
        elif a["size"] != b["size"] and not resized:
            changed["another size"].append(name)
        if a["blake2b"] != b["blake2b"] and (same_file or not resized):
            changed["another photograph"].append(name)
        if a["split"] != b["split"]:
            changed[held_out].append(name)
    changes = [_listed(what, names) for what, names in changed.items() if names]
    if earlier["points"] != now["points"] and not changes:
        counts = f"{earlier['points']['count']:,} then, {now['points']['count']:,} now"
        changes.append(f"other points ({counts})")
    return changes


def check(run: Run, scene: Scene, path: Path, resolution: int, *, accept: bool = False) -> bool:
    """Compare a scene, read from `path`, with the one that a run has begun with; True where it differs, as `accept`ed.

    Raises InputError where it differs otherwise, or where the model would not lie where its numbers say.
    """
    earlier = read(run)
    if earlier is None:
        return False
    known = known_digests(earlier)
    others = [path for _, path in run.checkpoints() if (digest := scene_of(path)) and digest not in known]
    if others and not accept:
        raise InputError(
            f"{others[-1]}: is of a training on another scene than {run.path} is of, expected one of this run; remove "
            "it, or --accept-changes goes on from it"
        )
    now = record_of(scene, resolution)
    changes = differences(earlier, now)
    if changes and not accept:
        raise InputError(
            f"{path}: is not the scene that {run.path} began with: {'; '.join(changes)}; expected the same views and "
            "photographs; --accept-changes goes on with these"
        )
    if earlier["origin"] != now["origin"]:
        raise InputError(
            f"{path}: lies elsewhere in the world than the scene that {run.path} began with (numbers count from "
            f"{now['origin']}, not {earlier['origin']}), expected the same place; start a new run"
        )
    return bool(changes or others)


def keep(run: Run, scene: Scene, *, resuming: bool) -> None:
    """Write scene.json, but for a run that goes on with what is there; a warning where nothing was."""
    known = read(run) if resuming else None
    if known is not None and known["resolution"] == run.config.resolution:
        return
    if known is None and resuming and run.checkpoints():
        warn(
            f"{run.path}: has no {NAME}, as runs of earlier versions: whether this is the scene it began with is "
            "not known; from now on it is"
        )
    write(run, scene)


def of_evaluation(run: Run, views: Sequence[View]) -> list[str]:
    """Reasons that scores of these views are not those of held-out photographs of the scene that the run has begun
    with."""
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
        and (was[view.name]["blake2b"] or "").partition(" ")[0] != (short_digest(view.path) or "")  # before its mask's
    ]
    reasons = []
    if seen:
        reasons.append(f"{len(seen):,} of {len(views):,} views were trained on ({examples(seen)}): they score too well")
    if changed:
        reasons.append(_listed("with another photograph than at the training", changed))
    if was and not known:
        reasons.append(f"none of the views is of the scene that {run.path} began with")
    return reasons


def _close(a: list[float], b: list[float]) -> bool:
    """True if two vectors are equal to SAME of their largest number, as a scene may be of any size."""
    one, other = np.array(a), np.array(b)
    return bool(np.abs(one - other).max() <= SAME * max(np.abs(one).max(), np.abs(other).max()))


def _listed(what: str, names: list[str]) -> str:
    """Such as "3 views not there any more (a.png, b.png, c.png)"."""
    return f"{len(names):,} {'view' if len(names) == 1 else 'views'} {what} ({examples(names)})"
