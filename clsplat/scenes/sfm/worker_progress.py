# SPDX-License-Identifier: Apache-2.0
"""Start of the worker process of structure from motion, and the progress of its stages."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import IO, Any

from clsplat.errors import ClsplatError
from clsplat.process import apart
from clsplat.progress import CountedFraction, Progress

UNDISTORTED_IMAGES = "undistorted/images"
"""Folder in the worker's folder for the undistorted photographs, until the stage ends."""
PLACED_CAMERAS_UNIT = "cameras placed"
"""Unit of the progress of placing cameras, as in "12 of 25 cameras placed"."""
# Each stage has a text for the user, and the table of the database or the folder in the worker's folder that gets an
# entry for each photograph or pair.
_PROGRESS_BY_STAGE = {
    "features": ("finding features", "keypoints"),
    "learned features": ("finding features", None),
    "pairs": ("choosing pairs", None),
    "matches": ("matching photos", "two_view_geometries"),
    "learned matches": ("matching photos", None),
    "more pairs": ("choosing more pairs", None),
    "more matches": ("matching more photos", "two_view_geometries"),
    "more learned matches": ("matching more photos", None),
    "cameras": ("placing cameras", None),
    "cameras again": ("placing cameras, second try", None),
    "cameras at once": ("placing all cameras at once", None),
    "points": ("adding points", None),
    "undistorting": ("undistorting photos", UNDISTORTED_IMAGES),
}


def run_worker(task: dict[str, Any], work: Path, report: Progress) -> dict[str, Any]:
    """Run `clsplat.scenes.sfm.worker` to its end. Returns the worker's answer, {"result"}, {"failure"} or {"refused"}.

    task: from `reconstruct.sfm_task`. work: folder for the worker's files and its log.
    Raises ClsplatError if the worker ends without an answer.
    """
    log_path = work / "log.txt"
    search_path = [str(Path(__file__).resolve().parents[3]), os.environ.get("PYTHONPATH", "")]
    with open(log_path, "wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "clsplat.scenes.sfm.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            encoding="utf-8",
            # One thread for NumPy's products, so that their bits do not depend on the number of threads.
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, search_path)), "OPENBLAS_NUM_THREADS": "1"},
            **apart(),  # Ctrl-C reaches only this process, which then ends the worker
        )
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            with contextlib.suppress(OSError):  # the worker has ended: broken pipe, or invalid argument on Windows
                process.stdin.write(json.dumps(task) + "\n")
                process.stdin.flush()
            answer = _follow(process.stdout, work, report)
            process.wait()
        finally:
            process.kill()
            process.wait()
            with contextlib.suppress(OSError):  # closing sends buffered input, which an ended worker cannot read
                process.stdin.close()
            process.stdout.close()
    if not answer:
        lines = [line.strip() for line in log_path.read_text("utf-8", errors="replace").splitlines() if line.strip()]
        raise ClsplatError(f"structure from motion failed (status {process.returncode}): {' | '.join(lines[-3:])}")
    return answer


def _follow(lines: IO[str], work: Path, report: Progress) -> dict[str, Any]:
    """Report the worker's progress until it answers. Returns the answer, {} if the worker ends without one.

    work: the worker's folder, in which the results of a stage are counted.
    """
    inbox: queue.Queue[str | None] = queue.Queue()

    def read() -> None:
        try:
            for line in lines:
                inbox.put(line)
        except ValueError:  # the stream is closed, because the caller was interrupted
            pass
        inbox.put(None)

    threading.Thread(target=read, daemon=True).start()
    text, results, total, places = "starting", None, None, False
    counted_at = time.monotonic()
    while True:
        try:
            line = inbox.get(timeout=0.25)
        except queue.Empty:
            if results and total and time.monotonic() - counted_at > 0.5:
                report(text, min(_count(work, results) / total, 1.0))
                counted_at = time.monotonic()
            continue
        if line is None:
            return {}
        message = json.loads(line)
        if message.keys() & {"result", "failure", "refused"}:
            return dict(message)
        if "stage" in message:
            text, results = _PROGRESS_BY_STAGE[message["stage"]]
            total, places = message["total"], message["stage"].startswith("cameras")
            report(text, None if not total else CountedFraction(0, total, PLACED_CAMERAS_UNIT) if places else 0.0)
        elif total and places:
            report(text, CountedFraction(message["done"], total, PLACED_CAMERAS_UNIT))
        elif total:
            report(text, min(message["done"] / total, 1.0))


def _count(work: Path, results: str) -> int:
    """Return the number of files of undistorted photographs, or of rows in a table of the worker's database.

    Returns 0 while the table cannot be read.
    """
    if results == UNDISTORTED_IMAGES:
        # Not rglob, which raises FileNotFoundError where the worker removes a folder meanwhile.
        return sum(len(files) for _, _, files in os.walk(work / UNDISTORTED_IMAGES))
    try:
        name = f"{(work / 'database.db').resolve().as_uri()}?mode=ro"
        with contextlib.closing(sqlite3.connect(name, uri=True, timeout=0.1)) as connection:
            return int(connection.execute(f"SELECT COUNT(*) FROM {results}").fetchone()[0])  # noqa: S608 - our names
    except sqlite3.Error:
        return 0
