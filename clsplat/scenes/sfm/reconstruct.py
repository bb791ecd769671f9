# SPDX-License-Identifier: Apache-2.0
"""Structure from motion with pycolmap on the CPU (`reconstruct`): a COLMAP scene with pinhole cameras from photos."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

from clsplat.config.masks import MaskUse
from clsplat.config.orientation import AS_IN_FILES, FrameUse
from clsplat.errors import InputError, examples, warn
from clsplat.files.atomic import move_into_place, work_folder
from clsplat.files.documents import is_file, load_document
from clsplat.progress import Progress, no_progress
from clsplat.scenes.geography.georeference import GEOREFERENCE_FILE
from clsplat.scenes.orientation.frame_record import FRAME_RECORD_FILE
from clsplat.scenes.sfm import copies as sfm_copies
from clsplat.scenes.sfm import focal_lengths
from clsplat.scenes.sfm import photos as sfm_photos
from clsplat.scenes.sfm.captured_files import SFM_RECORD_FILE
from clsplat.scenes.sfm.framing import scale_new, set_frame, turn_new
from clsplat.scenes.sfm.pipeline.photo_pairs import SFM_MATCHINGS
from clsplat.scenes.sfm.video_frames import VideoFrames, frames_of_videos
from clsplat.scenes.sfm.weights import learned_weights
from clsplat.scenes.sfm.worker_progress import run_worker
from clsplat.scenes.supervision.masks import OTHER_MASK_FOLDERS, masks_beside, stage_mask, warn_of_sense
from clsplat.scenes.video.reading import is_video_name

Mapper = Literal["auto", "global", "incremental"]
Features = Literal["sift", "aliked"]
Matching = Literal["auto", "exhaustive", "sequential", "spatial", "retrieval"]

MIN_SFM_PHOTOS = 3
"""Minimum number of photographs of a reconstruction."""
SFM_CAMERA_MODELS = ("auto", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL",
                 "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE")  # fmt: skip
"""Choices of `SfmSettings.camera_model`."""
SFM_MAPPERS: tuple[str, ...] = get_args(Mapper)
"""Choices of `SfmSettings.mapper`."""
SFM_FEATURES: tuple[str, ...] = get_args(Features)
"""Choices of `SfmSettings.features`."""
MAX_SFM_FEATURES, EARLIER_MAX_SFM_FEATURES = 4096, 8192
"""Default maximum number of features in a photograph: in this version, and in those before it.

The time of matching a pair of photographs grows faster than their number of features.
"""


@dataclass(frozen=True)
class SfmSettings:
    """Settings on which the recovered cameras depend.

    matching: the pairs of photographs that are matched. "exhaustive": all. "sequential": neighbours in each video, and
        outside videos in the order of names. "spatial": the nearest by EXIF's GPS. "retrieval": the most similar by
        their features. "auto": all pairs of up to 40 photographs. Of more: neighbours and the most similar if there
        are videos, the nearest if most have GPS positions and these differ enough, otherwise the most similar.
        After "spatial" and "retrieval" more pairs follow, which show the same by the matches of the first.
    camera_model: COLMAP name of the lens model that is fitted. "auto" is OPENCV for cameras with 20 photographs or
        more, otherwise SIMPLE_RADIAL (one distortion coefficient).
    shared_camera: which photographs share a camera, as in `photos.camera_groups`.
    max_image_size: longest side in pixels for finding features. The undistorted photographs keep their size.
    max_features: maximum number of features in a photograph; the largest are kept.
    mapper: "incremental" adds one photograph after another. "global" solves for all cameras at once. "auto" is
        "incremental", and also "global" if "incremental" places less than 60 % of the photographs. Of more than 40
        photographs with fewer than 5 for each camera, "global" is first.
    features: "sift", or "aliked", learned features.
    weights: for "aliked" the file of the network, or a name in `weights.WEIGHTS_BY_NAME`; None for the default name.
    seed: seed of random numbers. For up to 80 photographs, the same seed gives cameras with the same bits.
    frame: how the frame of the result is set. By default a new result is turned upright, and an earlier one keeps its
        frame. The cameras do not depend on it, so that an earlier result is used again in another frame.
    """

    matching: Matching = "auto"
    camera_model: str = "auto"
    shared_camera: bool | Literal["auto"] = "auto"
    max_image_size: int = 1600
    max_features: int = MAX_SFM_FEATURES
    seed: int = 0
    mapper: Mapper = "auto"
    features: Features = "sift"
    weights: str | None = None
    frame: FrameUse = AS_IN_FILES

    def check(self) -> None:
        """Raise InputError for an unknown choice, and for weights that are not used."""
        for name, given, choices in (
            ("matching", self.matching, SFM_MATCHINGS),
            ("mapper", self.mapper, SFM_MAPPERS),
            ("features", self.features, SFM_FEATURES),
            ("camera model", self.camera_model, SFM_CAMERA_MODELS),
        ):
            if given not in choices:
                raise InputError(f"{name} {given!r}: expected one of {', '.join(choices)}")
        if self.weights is not None and self.features == "sift":
            raise InputError(f"--weights {self.weights}: SIFT features have no weights, expected --features aliked")
        self.frame.check()

    def __str__(self) -> str:
        """Return the values of the settings in one line, for the fingerprint of a result.

        Mapper and features are left out by default, so that results of versions without these choices are reused. For
        the same reason the default number of features is written as EARLIER_MAX_SFM_FEATURES, and any other after "=".
        """
        lens = f"{self.camera_model} {self.shared_camera}"
        chosen = (self.mapper, self.features)
        more = "" if chosen == ("auto", "sift") else f" {self.mapper} {self.features}"
        most = f"={self.max_features}"
        if self.max_features == MAX_SFM_FEATURES:
            most = f"{EARLIER_MAX_SFM_FEATURES}"
        return f"{self.matching} {lens} {self.max_image_size} {most} {self.seed}{more}"


DEFAULT_SFM_SETTINGS = SfmSettings()


def reconstruct(
    images: Path,
    output: Path,
    settings: SfmSettings = DEFAULT_SFM_SETTINGS,
    *,
    threads: int | None = None,
    overwrite: bool = False,
    masks: MaskUse | None = None,
    frames: int | None = None,
    frames_to: Path | None = None,
    progress: Progress | None = None,
) -> Path:
    """Recover the cameras of the photographs under `images`, and write a COLMAP scene to `output`. Returns `output`.

    images: a folder with photographs, videos or both, or a video. Frames of videos are written to a folder, and used
        like photographs. A folder of frames from `take_frames` is used like its videos.

    The output has `images/` (undistorted, upright), `sparse/0/` (PINHOLE cameras, poses, points, frame.json) and
    sfm.json. It is created when all files are complete. A result for the same photographs and settings is reused.

    threads: number of CPU threads; None for one per core. overwrite: replace a result of other photographs.
    masks: use of masks and alpha. Masked pixels get no features. The output gets `masks/IMAGE.jpg.png`, white for kept.
    frames, frames_to: number of frames of each video, and their folder; None for a number by length and motion, and
        for a folder beside the output (`video_frames.frames_folder`).
    progress: function that is called with the name of a stage, and the fraction that is done, or None if unknown.

    Warns of copies, of which one is used, of photographs without a pose, in an unreadable format or without their
    alpha, and of focal lengths that differ from EXIF's. Raises InputError for a folder without photographs, a
    photograph that does not decode, an output that must not be replaced, and if the cameras cannot be recovered.
    Raises ClsplatError if pycolmap fails. After KeyboardInterrupt no files remain, except for the frames of videos if
    all of them were written. If earlier frames are to be replaced, they and an earlier result stay whole until the new
    result is complete.
    """
    report = progress or no_progress
    settings.check()
    _earlier_record(output)  # raises errors before videos are decoded, which takes minutes
    with frames_of_videos(images, output, frames, report, overwrite=overwrite, folder=frames_to) as videos:
        paths, copies, left_out = _files(images, output, videos)
        mask_files = _masks(images, paths, masks, videos)
        settings = _with_weights(settings)
        asked = f"{settings}{_described(masks, mask_files)}{_identity(settings.weights)}{videos.fingerprint}"
        fingerprint = sfm_photos.fingerprint(images, paths, asked)
        if _is_finished(output, images, fingerprint, overwrite=overwrite):
            report("using the cameras recovered before", 1.0)
            set_frame(output, images, settings.frame, output)
            return output
        _require_enough(images, len(paths) + len(videos.paths), videos)
        _warn_of_left_out(images, left_out)
        workers = threads or os.cpu_count() or 1
        with work_folder(output) as work:
            photos = _staged_photos(images, paths, copies, videos, work / "photos", report, workers)
            masked = _staged_masks(photos, mask_files, masks, work)
            task = sfm_task(settings, photos, masked, videos.sequences, work, workers)
            result = _recovered(images, len(photos), run_worker(task, work, report))
            turn_new(work / "result", images, settings.frame, images)
            _write_record(work / "result", fingerprint, photos, result)
            _warn_of_losses(images, photos, result, work / "result" / "images", masks)
            move_into_place(*videos.moves, (work / "result", output))
    scale_new(output, images, settings.frame)
    return output


def _files(
    images: Path, output: Path, videos: VideoFrames
) -> tuple[list[Path], dict[str, sfm_copies.Copy], dict[str, list[Path]]]:
    """Return the photographs without copies, the copies by name, and the files that are left out, by the reason."""
    paths, left_out = videos.photos_beside(images, output)
    copies = sfm_copies.found_by_name(images, [sfm_photos.photo_name(images, path) for path in paths])
    return [path for path in paths if sfm_photos.photo_name(images, path) not in copies], copies, left_out


def _warn_of_left_out(images: Path, left_out: dict[str, list[Path]]) -> None:
    """Warn of photographs, videos and folders that are left out. left_out: lists of files, keyed by the reason."""
    for why, others in left_out.items():
        names = [sfm_photos.photo_name(images, path) for path in others]
        kind = "folder(s)" if others[0].is_dir() else "video(s)" if all(map(is_video_name, others)) else "photo(s)"
        warn(f"{images}: {_listed(names, kind)} left out: {why}")


def _recovered(images: Path, count: int, answer: dict[str, Any]) -> dict[str, Any]:
    """Return the result in the worker's answer. Raises InputError if it has none. count: number of photographs."""
    if "refused" in answer:
        raise InputError(answer["refused"])
    if "failure" in answer:
        raise InputError(_no_model(images, count, answer["failure"]))
    return dict(answer["result"])


def _with_weights(settings: SfmSettings) -> SfmSettings:
    """Return the settings with the file of weights. If weights cannot be fetched, the settings choose SIFT features."""
    weights = learned_weights(settings.weights) if settings.features == "aliked" else None
    if weights is None:
        return replace(settings, features="sift", weights=None)
    return replace(settings, weights=str(weights))


def _identity(weights: str | None) -> str:
    """Return the digest of the file of weights as text for the fingerprint, empty without weights."""
    return f" {hashlib.sha256(Path(weights).read_bytes()).hexdigest()}" if weights else ""


def _described(masks: MaskUse | None, mask_files: dict[str, Path]) -> str:
    """Return the masks as text for the fingerprint: their use, and size and modification time of each mask file.

    mask_files: paths of the mask files, by photograph.
    """
    if masks is None:
        return ""
    stats = [(name, path.stat()) for name, path in sorted(mask_files.items())]
    return f" {masks} {[(name, status.st_size, status.st_mtime_ns) for name, status in stats]}"


def _staged_photos(
    images: Path,
    paths: list[Path],
    copies: dict[str, sfm_copies.Copy],
    videos: VideoFrames,
    target: Path,
    report: Progress,
    threads: int,
) -> list[sfm_photos.Photo]:
    """Put the photographs and the videos' frames under `target`. Returns them without copies, and warns of copies.

    copies: copies that were found before the photographs were decoded, by name.
    Raises InputError if too few photographs remain.
    """
    photos = sfm_photos.stage_photos(
        images, paths, target, lambda fraction: report("reading photos", fraction), threads
    )
    copies = sfm_copies.resolved({**copies, **sfm_copies.found_by_picture(photos)})
    photos = [photo for photo in photos if photo.name not in copies]
    if copies:
        count = "1 photograph is a copy of another" if len(copies) == 1 else f"{len(copies):,} photographs are copies"
        again = f"{count} and left out ({sfm_copies.listed(copies)}); to use the copies instead, give only their folder"
        warn(f"{images}: {again}")
    photos = videos.by_video(photos)
    photos += videos.staged(target, lambda fraction: report("reading frames", fraction), threads)
    _require_enough(images, len(photos), videos)
    return photos


def _staged_masks(
    photos: list[sfm_photos.Photo], mask_files: dict[str, Path], masks: MaskUse | None, work: Path
) -> list[str]:
    """Write the masks of the photographs under `work`. Returns the names in the scene of the photographs with a mask.

    mask_files: paths of the mask files, by photograph. A photograph's alpha may be a mask too.
    """
    if masks is None:
        return []
    masked = []
    for photo in photos:
        cut = photo.transparent and masks.alpha != "blend"
        if cut or photo.name in mask_files:
            mask_file, target = mask_files.get(photo.name), work / "masks" / f"{photo.scene_name}.png"
            inner = work / "photos" / photo.scene_name if cut else None
            stage_mask(mask_file, target, (photo.width, photo.height), invert=masks.invert, photo=inner)
            masked.append(photo.scene_name)
    return masked


def sfm_task(
    settings: SfmSettings,
    photos: list[sfm_photos.Photo],
    masked: list[str],
    sequences: list[list[str]],
    work: Path,
    threads: int,
) -> dict[str, Any]:
    """Return the task for the worker process (`clsplat.scenes.sfm.worker.Worker`), as values for JSON.

    settings: with the file of weights (`_with_weights`).
    masked: names of the photographs with a mask.
    sequences: names of each video's frames, in display order.
    work: folder for the photographs, masks and intermediate files.
    """
    names = {photo.scene_name for photo in photos}
    return {
        "masks": masked,
        "photos": str(work / "photos"),
        "work": str(work),
        "groups": sfm_photos.camera_groups(photos, settings.shared_camera),
        "sequences": [[name for name in frames if name in names] for frames in sequences],
        "features": settings.features,
        "weights": settings.weights or "",
        "matching": settings.matching,
        "mapper": settings.mapper,
        "camera_model": settings.camera_model,
        "max_image_size": settings.max_image_size,
        "max_features": settings.max_features,
        "threads": threads,
        "seed": settings.seed,
    }


def _write_record(folder: Path, fingerprint: str, photos: list[sfm_photos.Photo], result: dict[str, Any]) -> None:
    """Write sfm.json, the record of a reconstruction, into the folder of the result."""
    missing = sorted({photo.scene_name for photo in photos} - set(result["registered"]))
    record = {"fingerprint": fingerprint, "photos": len(photos), "unregistered": missing, **result}
    record["files"] = _sizes(folder)
    (folder / SFM_RECORD_FILE).write_bytes((json.dumps(record, indent=2) + "\n").encode())


def _warn_of_losses(
    images: Path, photos: list[sfm_photos.Photo], answer: dict[str, Any], result: Path, masks: MaskUse | None
) -> None:
    """Warn of focal lengths unlike EXIF's, photographs without a pose or in a smaller model, and lost alpha.

    answer: the worker's result, with the names of the photographs with a pose, and of those in smaller models.
    result: folder of the undistorted photographs.
    masks: use of masks and alpha. If alpha was used as a mask, its loss does not matter.
    """
    if told := focal_lengths.told(answer.get("focal_lengths", ())):
        warn(f"{images}: {told}")
    registered, others = answer["registered"], answer["fragments"]
    for names in others:
        warn(
            f"{images}: {_listed(names)} form a model of their own, with too few matches to the {len(registered):,} "
            "photo(s) that are used; to join both, add photos in between"
        )
    if missing := sorted({photo.scene_name for photo in photos}.difference(registered, *others)):
        warn(f"{images}: no camera pose was found for {_listed(missing)}, which will not be used")
    lost = _without_their_alpha(photos, registered, result)
    if lost and (masks is None or masks.alpha == "blend"):
        loss = "lost their alpha when they were undistorted: their images in the scene are opaque"
        warn(f"{images}: {_listed(lost)} {loss}")


@dataclass(frozen=True)
class _FoundPhoto:
    """A photograph: its path relative to the folder of photographs, and its file."""

    name: str
    path: Path


def _require_enough(images: Path, count: int, videos: VideoFrames) -> None:
    if count < MIN_SFM_PHOTOS:
        found, again = "photo(s) found", ""
        if videos.paths:
            found += f", {len(videos.paths)} of them from videos"
            again = "give a larger number with --frames, or leave --frames out"
            if videos.made is None:  # the frames stay, and would be used again
                again = f"remove the frames in {videos.folder}, and {again}"
            again = f"; {again}"
        raise InputError(f"{images}: only {count} {found}, expected at least {MIN_SFM_PHOTOS}{again}")


def _masks(images: Path, paths: list[Path], use: MaskUse | None, videos: VideoFrames) -> dict[str, Path]:
    """Find the masks of the photographs and of the videos' frames, by the photographs' and frames' names.

    Raises InputError if masks are requested but missing. Also raises it if a mask fits no photograph or frame, unless
    there are both, whose masks may be in one folder.
    """
    if use is None or use.masks == "none":
        return {}
    photos = [_FoundPhoto(sfm_photos.photo_name(images, path), path) for path in paths]
    frames = [_FoundPhoto(name, videos.folder / name) for name in videos.names]
    found: dict[str, Path] = {}
    for pictures in (photos, frames):
        if pictures:
            found |= masks_beside(pictures, strict=not (photos and frames), others=OTHER_MASK_FOLDERS)
    if not found:
        where = f"{videos.folder}, its folder of frames," if frames else "the photos' folder"
        name = frames[0].name if frames else "IMAGE.jpg"
        raise InputError(f"{images}: has no masks, expected masks/{name}.png in {where} or next to it")
    warn_of_sense(found.values(), use, images)
    return found


def _without_their_alpha(photos: list[sfm_photos.Photo], registered: list[str], result: Path) -> list[str]:
    """Return the names of transparent photographs that have no alpha after undistortion.

    pycolmap keeps alpha only if the lens model has no distortion, because it then copies the file.
    """
    transparent = {photo.scene_name for photo in photos if photo.transparent}
    return [name for name in registered if name in transparent and not sfm_photos.has_alpha(result / name)]


def _is_finished(output: Path, images: Path, fingerprint: str, *, overwrite: bool) -> bool:
    """Return True if the output is a complete result of the same photographs and settings.

    fingerprint: digest of the photographs and settings.
    overwrite: True if an earlier result of sfm may be replaced.
    Raises InputError for an output that must not be replaced.
    """
    record = _earlier_record(output)
    if record is None:
        return False
    complete = (output / "sparse/0/images.bin").is_file() and (output / "images").is_dir()
    files = record.get("files")
    was = files if isinstance(files, dict) else {}  # records of earlier versions have no list of files
    now = _sizes(output)
    changed = sorted(name for name, size in was.items() if now.get(name) != size)
    if complete and not changed and record.get("fingerprint") == fingerprint:
        return True
    if changed and not overwrite:
        raise InputError(
            f"{output}: {examples(changed)} were removed or changed after the cameras were recovered; remove the "
            "folder, or make it again with clsplat sfm --overwrite"
        )
    if not overwrite:
        raise InputError(
            f"{output}: its cameras were recovered with other settings or from other photos than those now in "
            f"{images}; remove it, choose another folder, or replace it with clsplat sfm --overwrite"
        )
    _check_replaceable(output)
    return False


def _earlier_record(output: Path) -> dict[str, Any] | None:
    """Return the record of an earlier result in the output; None if the output is empty or does not exist.

    Raises InputError for an output with anything else.
    """
    if not output.exists():
        return None
    if not output.is_dir():
        raise InputError(f"{output}: is a file, expected a folder for the scene or a new name")
    try:
        return load_document(output / SFM_RECORD_FILE, "the record of a result of sfm", "its fingerprint")
    except InputError:
        if any(output.iterdir()):
            raise InputError(f"{output}: is neither empty nor a result of sfm, expected a new folder") from None
        _check_replaceable(output)
        return None


def _check_replaceable(output: Path) -> None:
    """Raise InputError for an output such as . or .., which no system replaces by the finished folder."""
    if output.name in ("", ".."):
        raise InputError(
            f"{output}: is the working folder or one above, which cannot be replaced; give the name of a new folder"
        )


def _sizes(result: Path) -> dict[str, int]:
    """Return the size in bytes of each file of a result. The keys are paths relative to the result."""
    folders = (result / "images", result / "sparse", result / "masks")
    paths = (path for folder in folders for path in folder.rglob("*"))
    records = (FRAME_RECORD_FILE, GEOREFERENCE_FILE)  # they change without the cameras
    files = [path for path in sorted(paths) if path.name not in records and is_file(path)]
    return {path.relative_to(result).as_posix(): path.stat().st_size for path in files}


def _no_model(images: Path, count: int, evidence: dict[str, int]) -> str:
    return (
        f"{images}: no cameras could be recovered from {count} photos: the median photo has {evidence['features']} "
        f"features, {evidence['matched']} of {evidence['pairs']} pairs match, the best pair has {evidence['matches']} "
        "matches; expected sharp photos of one textured, still scene, each sharing half its view with its neighbours"
    )


def _listed(names: list[str], kind: str = "photo(s)") -> str:
    """Return text such as "3 photo(s) (a.jpg, b.jpg, c.jpg)", shortened if there are many names."""
    return f"{len(names):,} {kind} ({examples(names)})"
