# SPDX-License-Identifier: Apache-2.0
"""Structure from motion: a folder of photos to a COLMAP scene with pinhole cameras, by pycolmap on the CPU."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal

from clsplat.config.masks import MaskUse
from clsplat.errors import ClsplatError, InputError, examples, warn
from clsplat.files import is_file, replace
from clsplat.process import apart
from clsplat.progress import Counted, Progress, no_progress
from clsplat.scenes import sfm_copies, sfm_photos
from clsplat.scenes.camera_json import load_document
from clsplat.scenes.masks import OTHER_FOLDERS, masks_beside, stage_mask, warn_of_sense

Matching = Literal["auto", "exhaustive", "sequential"]

RECORD = "sfm.json"
"""File in the result: which photos and settings it was made from, which photos are missing, how good it is."""
EXHAUSTIVE_PHOTOS = 100
"""Up to here "auto" matches every pair: the pairs grow with the square, and a CPU does some 50 a second."""
MINIMUM_PHOTOS = 3
CAMERA_MODELS = ("auto", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL",
                 "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE")  # fmt: skip

STAND = "cameras stand"
# stage of the worker: what the user reads, and the table that grows by a row with each photo or pair
_STAGES = {
    "features": ("finding features", "keypoints"),
    "matches": ("matching photos", "two_view_geometries"),
    "cameras": ("placing cameras", None),
    "cameras again": ("placing cameras, second try", None),
    "undistorting": ("undistorting photos", None),
}


def reconstruct(
    images: Path,
    output: Path,
    *,
    matching: Matching = "auto",
    camera_model: str = "auto",
    shared_camera: bool | Literal["auto"] = "auto",
    max_image_size: int = 1600,
    max_features: int = 8192,
    threads: int | None = None,
    seed: int = 0,
    overwrite: bool = False,
    masks: MaskUse | None = None,
    progress: Progress | None = None,
) -> Path:
    """Recover the cameras of the photos under `images` and write a COLMAP scene to `output`, which is returned.

    output gets `images/` (undistorted, upright), `sparse/0/` (PINHOLE cameras, poses, points) and `sfm.json`. It
    appears when all is done, or not at all; a result of the same photos and settings is reused at once.

    matching: every pair, or neighbours in the order of the names; "auto" is every pair up to 100 photos.
    camera_model: the lens model that is fitted, a COLMAP name; "auto" is OPENCV for cameras with 20 photos or more,
    SIMPLE_RADIAL (one distortion coefficient) for others. shared_camera: see `sfm_photos.camera_groups`.
    max_image_size: pixels, longest side for features alone, the undistorted photos keep their size. threads: all
    cores if None. The same seed gives the same cameras, bit by bit up to 80 photos. overwrite: replace a result of
    other photos. masks: leave features out where the photos' masks, or their alpha, do; the output gets them too, as
    `masks/IMAGE.jpg.png`, white where a pixel counts. progress(text, fraction or None) is called in every stage.

    Of photos that are there twice one is used (`clsplat.scenes.sfm_copies`).

    Warns of these, and of photos that could not be placed, are of a kind that cannot be read, or lost their alpha.
    Raises InputError for a folder without photos, a photo that does not decode, an output that is something else, and
    photos that no cameras can be recovered from; ClsplatError where pycolmap itself fails. KeyboardInterrupt leaves
    nothing behind.
    """
    report = progress or no_progress
    if matching not in ("auto", "exhaustive", "sequential"):
        raise InputError(f"matching {matching!r}: expected auto, exhaustive or sequential")
    if camera_model not in CAMERA_MODELS:
        raise InputError(f"camera model {camera_model!r}: expected one of {', '.join(CAMERA_MODELS)}")
    paths, left_out = sfm_photos.find_photos(images, excluded=output)
    copies = sfm_copies.told_by_names(images, [sfm_photos.photo_name(images, path) for path in paths])
    paths = [path for path in paths if sfm_photos.photo_name(images, path) not in copies]
    settings = f"{matching} {camera_model} {shared_camera} {max_image_size} {max_features} {seed}"
    shapes = _masks(images, paths, masks)
    if masks is not None:
        stats = [(name, path.stat()) for name, path in sorted(shapes.items())]
        settings += f" {masks} {[(name, status.st_size, status.st_mtime_ns) for name, status in stats]}"
    fingerprint = sfm_photos.fingerprint(images, paths, settings)
    if _is_finished(output, images, fingerprint, overwrite=overwrite):
        report("using the cameras recovered before", 1.0)
        return output
    _require_enough(images, len(paths))
    for why, others in left_out.items():
        names = [sfm_photos.photo_name(images, path) for path in others]
        warn(f"{images}: {_listed(names)} left out: {why}")

    workers = threads or os.cpu_count() or 1
    output.parent.mkdir(parents=True, exist_ok=True)
    # beside the output, so that the last step is a rename within one file system
    work = Path(tempfile.mkdtemp(prefix=f".{output.name}-sfm-", dir=output.parent))
    try:
        photos = sfm_photos.stage_photos(
            images, paths, work / "photos", lambda fraction: report("reading photos", fraction), workers
        )
        copies = sfm_copies.resolved({**copies, **sfm_copies.told_by_pictures(photos)})
        photos = [photo for photo in photos if photo.name not in copies]
        if copies:
            count = (
                "1 photograph is a copy of another" if len(copies) == 1 else f"{len(copies):,} photographs are copies"
            )
            again = f"{count} and left out ({sfm_copies.listed(copies)}); to use copies, give their folder alone"
            warn(f"{images}: {again}")
        _require_enough(images, len(photos))
        masked = []
        for photo in photos:
            cut = photo.transparent and masks is not None and masks.alpha != "blend"
            if cut or photo.name in shapes:
                shape, target = shapes.get(photo.name), work / "masks" / f"{photo.name}.png"
                inner = work / "photos" / photo.name if cut else None
                invert = masks is not None and masks.invert
                stage_mask(shape, target, (photo.width, photo.height), invert=invert, photo=inner)
                masked.append(photo.name)
        task = {
            "masks": masked,
            "photos": str(work / "photos"),
            "work": str(work),
            "groups": sfm_photos.camera_groups(photos, shared_camera),
            "sequential": matching == "sequential" or (matching == "auto" and len(photos) > EXHAUSTIVE_PHOTOS),
            "camera_model": camera_model,
            "max_image_size": max_image_size,
            "max_features": max_features,
            "threads": workers,
            "seed": seed,
        }
        answer = _run_worker(task, work, report)
        if "failure" in answer:
            raise InputError(_no_model(images, len(photos), answer["failure"]))
        result = answer["result"]
        missing = sorted({photo.name for photo in photos} - set(result["registered"]))
        record = {"fingerprint": fingerprint, "photos": len(photos), "unregistered": missing, **result}
        record["files"] = _sizes(work / "result")
        (work / "result" / RECORD).write_bytes((json.dumps(record, indent=2) + "\n").encode())
        if missing:
            warn(f"{images}: {_listed(missing)} could not be placed and will not be used")
        lost = _without_their_alpha(photos, result["registered"], work / "result" / "images")
        if lost and (masks is None or masks.alpha == "blend"):
            loss = "lost their alpha when their lens was undone: the scene's images are opaque there"
            warn(f"{images}: {_listed(lost)} {loss}")
        _move_into_place(work, output)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return output


@dataclass(frozen=True)
class _Found:
    """A photo in the folder: its name below that, and its file."""

    name: str
    path: Path


def _require_enough(images: Path, count: int) -> None:
    if count < MINIMUM_PHOTOS:
        raise InputError(f"{images}: only {count} photo(s) found, expected at least {MINIMUM_PHOTOS}")


def _masks(images: Path, paths: list[Path], use: MaskUse | None) -> dict[str, Path]:
    """The masks by the photos' names. Raises InputError where they are asked for, and there are none or one fits no
    photo."""
    if use is None or use.masks == "none":
        return {}
    photos = [_Found(sfm_photos.photo_name(images, path), path) for path in paths]
    found = masks_beside(photos, others=OTHER_FOLDERS)
    if not found:
        raise InputError(
            f"{images}: there are no masks, expected masks/IMAGE.jpg.png beside the photos or in their folder"
        )
    warn_of_sense(found.values(), use, images)
    return found


def _without_their_alpha(photos: list[sfm_photos.Photo], registered: list[str], result: Path) -> list[str]:
    """Names of the photos with transparent parts that the result has without alpha: pycolmap keeps it only where the
    lens model has no distortion, and the file is copied."""
    transparent = {photo.name for photo in photos if photo.transparent}
    return [name for name in registered if name in transparent and not sfm_photos.has_alpha(result / name)]


def _is_finished(output: Path, images: Path, fingerprint: str, *, overwrite: bool) -> bool:
    """True if output is the result wanted. Raises InputError where it is something that must not be replaced."""
    if not output.exists():
        return False
    if not output.is_dir():
        raise InputError(f"{output}: is a file, expected a folder for the scene or a new name")
    try:
        record = load_document(output / RECORD, "the record of a result of sfm", "its fingerprint")
    except InputError:
        if any(output.iterdir()):
            raise InputError(f"{output}: is not empty and not a result of sfm, expected a new folder") from None
        return False
    complete = (output / "sparse/0/images.bin").is_file() and (output / "images").is_dir()
    files = record.get("files")
    was = files if isinstance(files, dict) else {}  # results of before have no such list
    now = _sizes(output)
    changed = sorted(name for name, size in was.items() if now.get(name) != size)
    if complete and not changed and record.get("fingerprint") == fingerprint:
        return True
    if changed and not overwrite:
        raise InputError(
            f"{output}: {examples(changed)} are gone or changed since the cameras were recovered; remove the folder, "
            "or make it anew with clsplat sfm --overwrite"
        )
    if not overwrite:
        raise InputError(
            f"{output}: holds cameras recovered from other photos or settings than {images} now; "
            "remove it or choose another folder"
        )
    return False


def _sizes(result: Path) -> dict[str, int]:
    """Bytes of the files of a result, by their names in it."""
    folders = (result / "images", result / "sparse", result / "masks")
    paths = (path for folder in folders for path in folder.rglob("*"))
    return {path.relative_to(result).as_posix(): path.stat().st_size for path in sorted(paths) if is_file(path)}


def _run_worker(task: dict[str, Any], work: Path, report: Progress) -> dict[str, Any]:
    """Run `clsplat.scenes.sfm_worker` to its end; returns its answer, {"result"} or {"failure"}."""
    log_path = work / "log.txt"
    search_path = [str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")]
    with open(log_path, "wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "clsplat.scenes.sfm_worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            encoding="utf-8",
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, search_path))},
            **apart(),  # Ctrl-C on the terminal is for us, and we end the worker
        )
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(json.dumps(task) + "\n")
            process.stdin.flush()
            answer = _follow(process.stdout, work / "database.db", report)
            process.wait()
        except OSError:  # the worker is gone: a broken pipe, or on Windows an invalid argument
            answer = {}
        finally:
            process.kill()
            process.wait()
            with contextlib.suppress(OSError):  # closing writes what the worker never read
                process.stdin.close()
            process.stdout.close()
    if not answer:
        lines = [line.strip() for line in log_path.read_text("utf-8", errors="replace").splitlines() if line.strip()]
        raise ClsplatError(f"structure from motion failed (status {process.returncode}): {' | '.join(lines[-3:])}")
    return answer


def _follow(lines: IO[str], database: Path, report: Progress) -> dict[str, Any]:
    """Report the worker's stages until its answer; an empty answer if it ends without one."""
    inbox: queue.Queue[str | None] = queue.Queue()

    def read() -> None:
        try:
            for line in lines:
                inbox.put(line)
        except ValueError:  # closed under us, as the caller was interrupted
            pass
        inbox.put(None)

    threading.Thread(target=read, daemon=True).start()
    text, table, total = "starting", None, None
    counted_at = time.monotonic()
    while True:
        try:
            line = inbox.get(timeout=0.25)
        except queue.Empty:
            if table and total and time.monotonic() - counted_at > 0.5:
                report(text, min(_rows(database, table) / total, 1.0))
                counted_at = time.monotonic()
            continue
        if line is None:
            return {}
        message = json.loads(line)
        if "result" in message or "failure" in message:
            return dict(message)
        if "stage" in message:
            text, table = _STAGES[message["stage"]]
            total, places = message["total"], message["stage"].startswith("cameras")
            report(text, None if not total else Counted(0, total, STAND) if places else 0.0)
        elif total:
            report(text, Counted(message["done"], total, STAND))


def _rows(database: Path, table: str) -> int:
    """Rows of a table that the worker is filling; 0 while it cannot be read."""
    try:
        name = f"{database.resolve().as_uri()}?mode=ro"
        with contextlib.closing(sqlite3.connect(name, uri=True, timeout=0.1)) as connection:
            return int(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])  # noqa: S608 - our names
    except sqlite3.Error:
        return 0


def _move_into_place(work: Path, output: Path) -> None:
    """Make the finished result `output`; an earlier one goes only when the new one stands."""
    earlier = work / "earlier"
    if output.exists():
        replace(output, earlier)
    try:
        replace(work / "result", output)
    except BaseException:
        if earlier.exists():
            replace(earlier, output)
        raise


def _no_model(images: Path, count: int, evidence: dict[str, int]) -> str:
    return (
        f"{images}: no cameras could be recovered from {count} photos: {evidence['features']} features in a typical "
        f"photo, {evidence['matched']} of {evidence['pairs']} pairs match, {evidence['matches']} matches in the best; "
        "expected sharp photos of one textured, still scene, each sharing half its view with others from beside it"
    )


def _listed(names: list[str]) -> str:
    """A line such as 3 photo(s) (a.jpg, b.jpg, c.jpg), cut where there are many."""
    return f"{len(names):,} photo(s) ({examples(names)})"
