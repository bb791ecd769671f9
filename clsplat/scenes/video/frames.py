# SPDX-License-Identifier: Apache-2.0
"""Frames of videos as photographs on the disk (`take_frames`), with a table of their times and measurements."""

from __future__ import annotations

import json
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from clsplat.errors import InputError, examples, warn
from clsplat.files.atomic import atomic_write, move_into_place, work_folder
from clsplat.files.documents import is_file, known_digest, load_document
from clsplat.images.reading import find_images
from clsplat.images.writing import write_spec
from clsplat.progress import Progress, no_progress
from clsplat.scenes.video.choice import Choice, choose
from clsplat.scenes.video.colours import display_rgb
from clsplat.scenes.video.motion import Measurements, Meter
from clsplat.scenes.video.preview import Preview, preview
from clsplat.scenes.video.reading import VideoFacts, VideoFrame, VideoReader, open_video

FRAME_TABLE_FILE = "frames.json"
"""File beside the frames with their names, times and measurements, and the videos' facts."""
FRAME_TABLE_VERSION = 2
"""Version of the table and of the choice of frames. Frames of another version are not used again."""
FRAME_JPEG_QUALITY = 97
"""JPEG quality of the frames. Their chroma is not subsampled."""
MIN_TEXTURED_FRACTION = 0.1
"""Smallest fraction of textured blocks, on average over all frames. A video with less shows a wall or is black."""
MIN_DECODED_FRACTION = 0.9
"""Smallest fraction of the frames announced in the header that must decode. With fewer, the file counts as cut off."""


@dataclass(frozen=True)
class FramesOfVideo:
    """Frames taken from one video.

    video: path of the video below the folder of the videos.
    names: paths of the frames below the folder of the frames, in display order.
    preview: report on the capture.
    """

    video: str
    names: tuple[str, ...]
    preview: Preview


@dataclass(frozen=True)
class TakenFrames:
    """The folder of the frames, with FRAME_TABLE_FILE in it, and the frames of each video.

    pending: True if the folder is hidden, as in `taking_frames`, and has yet to replace earlier frames.
    """

    folder: Path
    videos: tuple[FramesOfVideo, ...]
    pending: bool = False

    @property
    def names(self) -> list[str]:
        """Paths of all frames below the folder, sorted by name."""
        return sorted(name for video in self.videos for name in video.names)


def take_frames(
    videos: Sequence[Path],
    output: Path,
    *,
    root: Path | None = None,
    count: int | None = None,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> TakenFrames:
    """Choose frames of videos, and write them as photographs to the folder `output`.

    A frame's name is that of its video's file, followed by the number of the frame: walk.mp4/000123.jpg. The frames are
    upright, with the colours of photographs (`display_rgb`). The same videos give the same bytes again, and the
    modification times of the videos. An existing folder with frames of the same videos is used again if it was made
    with the same `count`, or if `count` is None.

    Each video is decoded twice: once for the choice, which depends on the whole video, and once for the chosen frames.

    root: folder below which the videos are named; by default the first video's folder.
    count: number of frames of each video; None for a number by the video's length and motion.
    overwrite: replace frames of other videos, or of another count.
    progress: function that is called with the name of a stage, and the fraction that is done, or None if unknown.

    Warns of captures that are too fast, too dark, not sharp or without parallax, and of videos that are cut off. Raises
    InputError for a file that is not a video or shows nothing, and for an output that must not be replaced. After
    KeyboardInterrupt no files remain, and frames that were to be replaced are whole.
    """
    with taking_frames(videos, output, root=root, count=count, overwrite=overwrite, progress=progress) as taken:
        pass
    return replace(taken, folder=output, pending=False)


@contextmanager
def taking_frames(
    videos: Sequence[Path],
    output: Path,
    *,
    root: Path | None,
    count: int | None,
    overwrite: bool,
    progress: Progress,
) -> Iterator[TakenFrames]:
    """Context manager that takes frames like `take_frames`, and replaces earlier frames only at the end of the block.

    Until then the new frames are in a hidden folder beside `output`. The block may call `move_into_place` for them
    itself, together with its own result. If it raises an exception, also KeyboardInterrupt, earlier frames stay.
    """
    if count is not None and count < 1:
        raise InputError(f"{count} frames of a video were asked for, expected at least 1")
    base = root or videos[0].parent
    names = [path.relative_to(base).as_posix() for path in videos]
    wanted: list[dict[str, Any]] = [
        {"video": name, "sha256": _digest_of(path), "asked": count} for name, path in zip(names, videos, strict=True)
    ]
    if (taken := _taken_before(output, wanted, any_count=count is None, overwrite=overwrite)) is not None:
        progress("using the frames taken before", 1.0)
        yield taken
        return
    with work_folder(output) as work:
        made = work / "result"
        rows = [
            {**row, **_frames_of(path, row["video"], made, count, progress)}
            for row, path in zip(wanted, videos, strict=True)
        ]
        table = {"version": FRAME_TABLE_VERSION, "videos": rows}
        atomic_write(made / FRAME_TABLE_FILE, (json.dumps(table, indent=1) + "\n").encode())
        if is_file(output / FRAME_TABLE_FILE):
            yield replace(_from_table(made, table), pending=True)
            if made.exists():
                move_into_place((made, output))
            return
        move_into_place((made, output))
    yield _from_table(output, table)


def frame_sequences(folder: Path) -> list[list[str]]:
    """Return the frames' names in display order, a list for each video, by the table of a folder of frames.

    The list is empty for a folder without a table, or with another program's file of the table's name. Frames that no
    longer exist are left out.
    """
    try:
        taken = _from_table(folder, _table(folder))
    except InputError:
        return []
    present = [[name for name in video.names if is_file(folder / name)] for video in taken.videos]
    return [names for names in present if names]


def _digest_of(video: Path) -> str:
    if not is_file(video):
        found = "is a folder" if video.is_dir() else "no such file"
        raise InputError(f"{video}: {found}, expected a video")
    return known_digest(video)


def _table(folder: Path) -> dict[str, Any]:
    table = load_document(folder / FRAME_TABLE_FILE, "the table of a video's frames", "its videos")
    if not _is_table(table):
        raise InputError(f"{folder / FRAME_TABLE_FILE}: is not a table of a video's frames, expected its videos")
    return table


def _is_table(table: dict[str, Any]) -> bool:
    """Return True if a JSON object has those parts of a table of frames that clsplat reads."""
    rows = table.get("videos")
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        return False
    frames = [row.get("frames") for row in rows]
    if not all(
        isinstance(row.get("video"), str) and isinstance(each, list) for row, each in zip(rows, frames, strict=True)
    ):
        return False
    return all(isinstance(frame, dict) and isinstance(frame.get("name"), str) for each in frames for frame in each)


def _from_table(folder: Path, table: dict[str, Any]) -> TakenFrames:
    videos = (
        FramesOfVideo(
            row["video"],
            tuple(frame["name"] for frame in row["frames"]),
            Preview(str(row.get("preview", "")), tuple(map(str, row.get("advice") or ()))),
        )
        for row in table["videos"]
    )
    return TakenFrames(folder, tuple(videos))


def _taken_before(
    output: Path, wanted: list[dict[str, Any]], *, any_count: bool, overwrite: bool
) -> TakenFrames | None:
    """Return the frames in the output if they are of the same videos and counts; None if frames have to be taken.

    wanted: name, SHA-256 and number of frames of each video, as in the table.
    any_count: accept any number of frames of the same videos.
    Raises InputError for an output with anything else, unless it holds frames and `overwrite` is True.
    """
    if not output.exists():
        return None
    if not output.is_dir():
        raise InputError(f"{output}: is a file, expected a folder for frames or a new name")
    if not is_file(output / FRAME_TABLE_FILE):
        if any(output.iterdir()):
            raise InputError(f"{output}: is neither empty nor a folder of a video's frames, expected a new folder")
        return None
    table = _table(output)
    keys = ("video", "sha256") if any_count else ("video", "sha256", "asked")
    have, need = ([{key: row.get(key) for key in keys} for row in rows] for rows in (table["videos"], wanted))
    same = have == need
    sizes = {frame["name"]: frame.get("bytes") for row in table["videos"] for frame in row["frames"]}
    changed = sorted(name for name, size in sizes.items() if _size(output / name) != size)
    if same and not changed and table.get("version") == FRAME_TABLE_VERSION:
        return _from_table(output, table)
    if not overwrite:
        why = "has frames of other videos, or another number of frames"
        if not any_count:
            why += " (without --frames, frames of the same videos are used as they are)"
        if same:
            why = (
                f"{examples(changed)} were removed or changed" if changed else "was made by another version of clsplat"
            )
        raise InputError(
            f"{output}: {why}; give this folder in place of the video, remove it, or give --overwrite to clsplat sfm "
            "or capture"
        )
    taken = {output / name for name in sizes}
    if others := [path.relative_to(output).as_posix() for path in find_images(output) if path not in taken]:
        raise InputError(
            f"{output}: has pictures beside its frames ({examples(others)}), which would be removed; move them to "
            "another folder to replace the frames"
        )
    return None


def _size(path: Path) -> int:
    return path.stat().st_size if is_file(path) else -1


def _frames_of(path: Path, name: str, folder: Path, count: int | None, progress: Progress) -> dict[str, Any]:
    """Write the chosen frames of one video below `folder`. Returns the video's part of the table.

    name: path of the video below the folder of the videos.
    count: number of frames; None for a number by the video's length and motion.
    """
    with open_video(path) as reader:
        measured, numbers, turns = measure_video(reader, lambda done: progress(f"reading {name}", done))
        facts = reader.facts.turned(turns)
        _check(path, reader, measured)
    choice = choose(measured, count)
    if not len(choice.frames):
        raise InputError(
            f"{path}: all of its {len(measured):,} frames are blurred, damaged or of a fast camera, expected a slower "
            "camera"
        )
    told = preview(facts, measured, choice)
    progress(f"{name}: {told.text}", None)
    for advice in told.advice:
        warn(f"{path}: {advice}")
    files = {numbers[row]: f"{name}/{numbers[row]:06d}.jpg" for row in choice.frames.tolist()}
    (folder / name).mkdir(parents=True)
    with open_video(path) as reader:
        _write(reader, facts, folder, files, turns, lambda done: progress(f"writing the frames of {name}", done))
    changed = path.stat().st_mtime_ns
    for file in files.values():  # so that frames that are taken again count as the same photographs
        os.utime(folder / file, ns=(changed, changed))
    return {**_described(facts, turns), **_listed(folder, files, measured, choice, numbers), **_told(told)}


def measure_video(reader: VideoReader, report: Callable[[float], None]) -> tuple[Measurements, list[int], int]:
    """Measure all frames of a video, except frames whose size differs from the first frame's.

    report: function that is called with the fraction of the video that is done.
    Returns the measurements, the number of each measured frame in display order, and the quarter turns of
    `VideoFrame.quarter_turns`. Raises InputError if no frame decodes.
    """
    coding, meter, shape = reader.facts.coding, None, (0, 0)
    numbers: list[int] = []
    turns = 0
    for frame in reader.frames():
        planes = frame.planes()
        if meter is None:
            most = (1 << planes.bits) - 1
            low, high = (0, most) if coding.full_range else (16 << (planes.bits - 8), 235 << (planes.bits - 8))
            meter, shape, turns = Meter(low, high), planes.y.shape, frame.quarter_turns
        if planes.y.shape != shape:
            reader.trouble.append("the size of the pictures changes")
            continue
        meter.add(planes.y, frame.seconds, whole=frame.whole)
        numbers.append(frame.index)
        if reader.facts.seconds and len(numbers) % 16 == 0:
            report(min(frame.seconds / reader.facts.seconds, 1.0))
    if meter is None:
        why = f": {reader.trouble[0]}" if reader.trouble else ""
        raise InputError(f"{reader.path}: has no frame that decodes{why}; expected a video with pictures")
    return meter.measurements(), numbers, turns


def _check(path: Path, reader: VideoReader, measured: Measurements) -> None:
    """Warn of a video that is cut off or damaged. Raises InputError for a video that shows nothing."""
    announced, damaged = reader.facts.frames, int((~measured.whole).sum())
    if len(measured) < MIN_DECODED_FRACTION * announced:
        warn(
            f"{path}: is cut off or damaged: {len(measured):,} of {announced:,} frames decode, which are used; copy "
            "the file again for the others"
        )
    elif reader.trouble or damaged:
        why = reader.trouble[0] if reader.trouble else f"{damaged:,} frames"
        warn(f"{path}: has damaged parts ({why}), which are not used; copy the file again")
    if (textured := float(measured.textured.mean())) < MIN_TEXTURED_FRACTION:
        level = 100 * float(np.median(measured.brightness))
        raise InputError(
            f"{path}: shows no texture in {100 * (1 - textured):.0f} % of its picture (brightness {level:.0f} % of "
            "white), expected a video of a textured, lit scene"
        )


def _write(
    reader: VideoReader,
    facts: VideoFacts,
    folder: Path,
    files: dict[int, str],
    turns: int,
    report: Callable[[float], None],
) -> None:
    """Decode a video up to the last chosen frame, and write the chosen frames.

    files: paths of the chosen frames below `folder`, by the frames' numbers.
    turns: counter-clockwise quarter turns that bring the frames upright.
    report: function that is called with the fraction that is done.
    """
    last = max(files)
    waiting: deque[Future[None]] = deque()
    workers = min(4, os.cpu_count() or 1)
    done = 0
    with ThreadPoolExecutor(workers) as pool:
        try:
            for frame in reader.frames():
                if frame.index in files:
                    waiting.append(pool.submit(_write_frame, frame, facts, turns, folder / files[frame.index]))
                while len(waiting) > workers:  # each future holds a decoded frame in memory
                    waiting.popleft().result()
                    done += 1
                    report(done / len(files))
                if frame.index >= last:
                    break
            for each in waiting:
                each.result()
                done += 1
            report(1.0)
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    if done < len(files):
        raise InputError(f"{reader.path}: changed while its frames were taken: {done} of {len(files)} were found again")


def _write_frame(frame: VideoFrame, facts: VideoFacts, turns: int, path: Path) -> None:
    write_frame(path, display_rgb(frame.planes(), facts.coding, turns), facts.make, facts.model)


def write_frame(path: Path, pixels: NDArray[np.uint8], make: str = "", model: str = "") -> None:
    """Write a frame (H, W, 3) as a JPEG, with the camera's make and model. Raises ClsplatError if writing fails."""
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, "uint8")
    spec.attribute("Compression", f"jpeg:{FRAME_JPEG_QUALITY}")
    spec.attribute("jpeg:subsampling", "4:4:4")
    for key, text in (("Make", make), ("Model", model)):
        if text.isprintable() and text:
            spec.attribute(key, text)
    write_spec(path, [pixels], [spec], "jpeg")


def _described(facts: VideoFacts, turns: int) -> dict[str, Any]:
    """Return a video's facts for the table, without facts that the file lacks. turns: quarter turns of the frames."""
    optional = {"place": list(facts.place), "time": facts.time, "make": facts.make, "model": facts.model}
    return {
        "width": facts.width,
        "height": facts.height,
        "turned": 90 * turns,
        "codec": facts.codec,
        "range": facts.coding.label,
        **{key: value for key, value in optional.items() if value},
    }


def _told(told: Preview) -> dict[str, Any]:
    return {"preview": told.text, "advice": list(told.advice)}


def _listed(
    folder: Path, files: dict[int, str], measured: Measurements, choice: Choice, numbers: list[int]
) -> dict[str, Any]:
    """Return the number of measured frames, and the entries of the chosen frames, for the table.

    files: paths of the chosen frames below `folder`, by the frames' numbers.
    numbers: number of each measured frame in display order.
    """
    frames = [
        {
            "name": files[numbers[row]],
            "frame": numbers[row],
            "seconds": round(float(measured.seconds[row]), 6),
            "sharpness": round(float(measured.sharpness[row]), 4),
            "bytes": (folder / files[numbers[row]]).stat().st_size,
        }
        for row in choice.frames.tolist()
    ]
    return {"decoded": len(measured), "frames": frames}
