# SPDX-License-Identifier: Apache-2.0
"""Worker process that runs structure from motion with pycolmap, started by `clsplat.scenes.sfm.reconstruct`.

A separate process is needed for three reasons. pycolmap's long calls ignore Ctrl-C, its log goes to the standard error
of the process, and a crash in native code must not end the caller.

The task is one line of JSON on standard input, which then stays open. When it closes, the parent has ended, and the
worker ends too. Answers are lines of JSON on standard output: {"stage", "total"}, {"done"} during a stage, and
{"result"}, {"failure"} or {"refused"} at the end.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

import pycolmap

from clsplat.scenes.sfm import focal_lengths
from clsplat.scenes.sfm.pipeline import aliked, mapping, matching
from clsplat.scenes.sfm.pipeline.database import feature_evidence, keep_largest, renumber_by_name, write_cameras
from clsplat.scenes.sfm.pipeline.features import extract_sift
from clsplat.scenes.sfm.pipeline.photo_pairs import MAX_EXHAUSTIVE_PHOTOS, Pair, joined
from clsplat.scenes.sfm.worker_progress import UNDISTORTED_IMAGES

MAX_SINGLE_THREAD_PHOTOS = 80
"""Number of photographs up to which matching and mapping run on one thread each, so that their results are
reproducible.

Mapping on several threads adds in varying order. Matching on several threads multiplies matrices in each of them. The
OpenBLAS of pycolmap 4.2 is built without locks, so two threads may use the same scratch memory. Then some features are
matched wrongly, once in about 70 reconstructions on a busy machine. Matches are verified in another thread.
"""
GLOBAL_FOLDER = "sparse-global"
"""Folder in the worker's folder for the models of the global mapper."""
MIN_GPS_PRIOR_PHOTOS = 200
"""Number of photographs from which GPS positions hold the cameras, if pairs are chosen by them too.

Long strips of photographs drift without them. The cameras of fewer photographs hardly change, but take twice the time.
"""
RELAXED_FOLDER = "sparse-relaxed"
"""Folder in the worker's folder for the models of the incremental mapper with lower thresholds."""
TWO_ROUND_MATCHINGS = ("retrieval", "spatial")
"""Choices of pairs after which a second round of matching follows (`matching.overlapping_pairs`)."""
MIN_PLACED_FRACTION = 0.6
"""Fraction of the photographs below which mapping is repeated in another way."""
MIN_PHOTOS_PER_CAMERA = 5
"""Mean number of photographs of a camera below which "auto" uses the global mapper first. It never does so for
MAX_EXHAUSTIVE_PHOTOS or fewer photographs."""
MIN_PLACED_AT_ONCE_FRACTION = 0.3
"""Fraction of the photographs below which the incremental mapper follows where the global mapper was first. Many
photographs from the web show something else, and the incremental mapper places no more of them."""


class Worker:
    """One reconstruction from photographs. `run` calls the methods for its stages in order.

    task: see `sfm.reconstruct.sfm_task`. "photos" and "work" are folders. Each of "groups" lists the names of the
        photographs of one camera, each of "sequences" the frames of one video.
    channel: stream for the answers to the parent.
    """

    def __init__(self, task: dict[str, Any], channel: TextIO) -> None:
        self.task, self.channel = task, channel
        self.photos, self.work = Path(task["photos"]), Path(task["work"])
        self.database = self.work / "database.db"
        self.count = sum(map(len, task["groups"]))
        self.placed, self.by_gps = 0, False
        self.without_focal: list[pycolmap.Camera] = []
        self.seconds: dict[str, dict[str, float]] = {}
        self._stage, self._began = "", (0.0, 0.0)

    @property
    def reproducible_threads(self) -> int:
        """Number of threads of the stages whose results depend on it; see MAX_SINGLE_THREAD_PHOTOS."""
        threads: int = self.task["threads"]
        return 1 if self.count <= MAX_SINGLE_THREAD_PHOTOS else threads

    def say(self, **message: Any) -> None:
        print(json.dumps(message), file=self.channel, flush=True)

    def begin(self, stage: str, total: int | None) -> None:
        """End the stage before, begin a stage, and tell the parent.

        total: number of photographs or pairs in the new stage; None if unknown.
        """
        self.end()
        self._stage, self._began = stage, _clocks()
        self.say(stage=stage, total=total)

    def end(self) -> None:
        """Write the wall time and processor time of the ending stage to `seconds`."""
        if self._stage:
            wall, processor = (now - then for now, then in zip(_clocks(), self._began, strict=True))
            self.seconds[self._stage] = {"wall": round(wall, 2), "processor": round(processor, 2)}
        self._stage = ""

    def run(self) -> None:
        pycolmap.set_random_seed(self.task["seed"])
        try:
            self.extract()
        except aliked.WeightsError as error:
            self.say(refused=f"{self.task['weights']}: {error}")
            return
        given = focal_lengths.from_exif(self.database)
        try:
            chosen, pairs = self.match()
            self.by_gps = chosen == "spatial" and self.count >= MIN_GPS_PRIOR_PHOTOS
        except matching.NoPositionsError as error:
            self.say(refused=str(error))
            return
        models = self.map()
        if not models:
            self.say(failure=feature_evidence(self.database))
            return
        best, others = mapping.fragments(models)
        model = self.add_points(best)
        self.begin("undistorting", model.num_reg_images())
        self.undistort(best)
        self.end()
        self.say(
            result={
                "registered": mapping.placed_names(model),
                "fragments": others,
                "points": model.num_points3D(),
                "mean_reprojection_error": model.compute_mean_reprojection_error(),
                "features": self.task["features"],
                "matching": chosen,
                "pairs": pairs,
                "mapper": "global" if best.parent.name == GLOBAL_FOLDER else "incremental",
                "seconds": self.seconds,
                "pycolmap": pycolmap.__version__,
                "focal_lengths": focal_lengths.compared(model, given),
            }
        )

    def extract(self) -> None:
        """Extract the features of every photograph into the database, with one camera for each group."""
        if self.task["features"] == "aliked":
            network = aliked.AlikedNetwork(Path(self.task["weights"]))
            self.begin("learned features", self.count)
            aliked.extract_aliked(self.database, self.task, network, lambda done: self.say(done=done))
        else:
            self.begin("features", self.count)
            extract_sift(self.database, self.task)
            keep_largest(self.database, self.task["max_features"])
        renumber_by_name(self.database)

    def match(self) -> tuple[str, int]:
        """Match and verify the features of the chosen pairs. Returns the matching and its number of pairs.

        Spatial matching and retrieval have a second round, with pairs that show the same by the matches of the first.
        After spatial matching it also has pairs by similarity, for photographs whose GPS position may be wrong.
        """
        seed = self.task["seed"]
        self.begin("pairs", None)
        chosen, pairs = matching.matched_pairs(self.database, self.task["matching"], self.task["sequences"], seed)
        self.match_pairs(pairs)
        if chosen in TWO_ROUND_MATCHINGS:
            self.begin("more pairs", None)
            more = matching.overlapping_pairs(self.database, pairs)
            if chosen == "spatial":
                more = joined(more, matching.pairs_of_unconnected(self.database, pairs, seed))
            if more:
                self.match_pairs(more, before=len(pairs))
            pairs += more
        return chosen, len(pairs)

    def match_pairs(self, pairs: Sequence[Pair], *, before: int = 0) -> None:
        """Match and verify the features of pairs of photographs.

        before: number of pairs of the first round, in the second round of matching.
        """
        seed, threads, first = self.task["seed"], self.reproducible_threads, self.is_global_first()
        which, total = "more " if before else "", before + len(pairs)
        if self.task["features"] == "aliked":
            self.begin(f"{which}learned matches", total)
            aliked.match_aliked(
                self.database,
                pairs,
                threads=threads,
                seed=seed,
                with_focal=first,
                done=lambda done: self.say(done=before + done),
            )
        else:
            self.begin(f"{which}matches", total)  # the parent counts the pairs in the database
            matching.match_features(self.database, pairs, threads=threads, seed=seed, with_focal=first)

    def map(self) -> mapping.Models:
        """Recover camera poses and points. Returns all models.

        "auto" adds one photograph after another. If few are placed, as after a bad first pair, it solves for all at
        once. If few are placed again, the cameras may be close together, or there may be few features. Then
        photographs are added with lower thresholds. "incremental" does the same without solving for all at once.

        Photographs of many cameras, as from the web, have many bad first pairs. There "auto" solves for all at once
        first, and adds one photograph after another only if that places very few.
        """
        choice, at_once_first = self.task["mapper"], self.is_global_first()
        models = self.solve_at_once() if at_once_first else {}
        if choice == "global" or (at_once_first and not self.places_few(models, MIN_PLACED_AT_ONCE_FRACTION)):
            return models
        models |= self.add_one_by_one(relaxed=False)
        if choice == "auto" and not at_once_first and self.places_few(models):
            models |= self.solve_at_once()
        if self.places_few(models):
            models |= self.add_one_by_one(relaxed=True)
        return models

    def is_global_first(self) -> bool:
        """Return True if the global mapper is the first or the only one."""
        return self.task["mapper"] == "global" or (self.task["mapper"] == "auto" and self.has_many_cameras())

    def has_many_cameras(self) -> bool:
        """Return True if there are fewer than MIN_PHOTOS_PER_CAMERA photographs for each camera in the mean."""
        return self.count > MAX_EXHAUSTIVE_PHOTOS and self.count < MIN_PHOTOS_PER_CAMERA * len(self.task["groups"])

    def places_few(self, models: mapping.Models, fraction: float = MIN_PLACED_FRACTION) -> bool:
        """Return True if the largest model has less than this fraction of the photographs."""
        most = max((model.num_reg_images() for model in models.values()), default=0)
        return most < fraction * self.count

    def solve_at_once(self) -> mapping.Models:
        """Recover models by global mapping."""
        self.begin("cameras at once", None)
        write_cameras(self.database, self.without_focal)
        return mapping.global_models(
            self.database,
            self.photos,
            self.work / GLOBAL_FOLDER,
            threads=self.reproducible_threads,
            seed=self.task["seed"],
        )

    def add_points(self, best: Path) -> pycolmap.Reconstruction:
        """Add points that only two photographs show to the model in the folder `best`. Returns the model."""
        self.begin("points", None)
        return mapping.add_two_view_points(
            self.database,
            self.photos,
            best,
            threads=self.reproducible_threads,
            seed=self.task["seed"],
            relaxed=best.parent.name == RELAXED_FOLDER,
        )

    def add_one_by_one(self, *, relaxed: bool) -> mapping.Models:
        """Recover models by incremental mapping. relaxed: as in `mapping.incremental_models`."""
        self.begin("cameras again" if relaxed else "cameras", self.count)
        self.without_focal = matching.find_focal_lengths(self.database)
        self.placed = 2
        return mapping.incremental_models(
            self.database,
            self.photos,
            self.work / (RELAXED_FOLDER if relaxed else "sparse"),
            threads=self.reproducible_threads,
            seed=self.task["seed"],
            relaxed=relaxed,
            by_gps=self.by_gps,
            placed=self.count_one,
        )

    def count_one(self) -> None:
        """Tell the parent that one more camera is placed."""
        self.placed += 1
        self.say(done=min(self.placed, self.count))

    def undistort(self, model: Path) -> None:
        """Resample the registered photographs to pinhole cameras, in the layout that COLMAP's readers expect."""
        flat, result = self.work / Path(UNDISTORTED_IMAGES).parent, self.work / "result"
        pycolmap.undistort_images(
            output_path=flat,
            input_path=model,
            image_path=self.photos,
            output_type="COLMAP",
            undistort_options=pycolmap.UndistortCameraOptions(),
            jpeg_quality=97,
            num_threads=self.task["threads"],
        )
        (result / "sparse").mkdir(parents=True)
        (flat / "images").rename(result / "images")
        (flat / "sparse").rename(result / "sparse" / "0")
        as_pinhole(result / "sparse" / "0")
        shutil.rmtree(flat)
        self.undistort_masks(model, result / "masks")

    def undistort_masks(self, model: Path, result: Path) -> None:
        """Undistort the masks of the registered photographs like the photographs. The mask of NAME is NAME.png."""
        placed = pycolmap.Reconstruction(model)
        named = {placed.images[image].name: placed.images[image] for image in placed.reg_image_ids()}
        for name in set(self.task["masks"]) & named.keys():
            mask = pycolmap.Bitmap.read(self.work / "masks" / f"{name}.png", as_rgb=False)
            camera = placed.cameras[named[name].camera_id]
            flat, _ = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), mask, camera)
            path = result / f"{name}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            flat.write(path)


def _clocks() -> tuple[float, float]:
    """Return the wall time and the processor time of this process in seconds."""
    return time.monotonic(), time.process_time()


def as_pinhole(folder: Path) -> None:
    """Rewrite a model's SIMPLE_PINHOLE cameras, which undistortion keeps, as PINHOLE like all other cameras."""
    model = pycolmap.Reconstruction(folder)
    simple = [camera for camera in model.cameras.values() if camera.model_name == "SIMPLE_PINHOLE"]
    for camera in simple:
        focal, cx, cy = camera.params
        camera.model = pycolmap.CameraModelId.PINHOLE
        camera.params = [focal, focal, cx, cy]
    if simple:
        model.write(folder)


def _end_with_parent(stream: TextIO) -> None:
    stream.read()
    os._exit(3)


def main() -> None:
    """Read the task from standard input, run it, and send the answer to standard output."""
    # Native code prints to standard output, too. Send that to standard error: standard output is for answers.
    channel = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    task = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, args=(sys.stdin,), daemon=True).start()
    pycolmap.logging.minloglevel = pycolmap.logging.Level.WARNING.value
    Worker(task, channel).run()
    channel.flush()
    # Skip the teardown of native threads: the answer is sent, and the parent process removes the folder.
    os._exit(0)


if __name__ == "__main__":
    main()
