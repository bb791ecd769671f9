# SPDX-License-Identifier: Apache-2.0
"""Worker process that runs structure from motion with pycolmap, started by `clsplat.scenes.sfm.reconstruct`.

A separate process is needed for three reasons. pycolmap's long calls ignore Ctrl-C, its log goes to the standard error
of the process, and a crash in native code must not end the caller.

The task is one line of JSON on standard input, which then stays open. When it closes, the parent has ended, and the
worker ends too. Answers are lines of JSON on standard output: {"stage", "total"}, {"done"} during a stage, and
{"result"} or {"failure"} at the end.
"""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import statistics
import sys
import threading
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, TextIO

import pycolmap

from clsplat.scenes.sfm import focal_lengths

MAX_SINGLE_THREAD_PHOTOS = 80
"""Number of photographs up to which matching and mapping run on one thread each, so that their results are
reproducible.

Mapping on several threads adds in varying order. Matching on several threads multiplies matrices in each of them. The
OpenBLAS of pycolmap 4.2 is built without locks, so two threads may use the same scratch memory. Then some features are
matched wrongly, once in about 70 reconstructions on a busy machine. Verification of matches has a thread of its own.
"""
MIN_OPENCV_PHOTOS = 20
"""Minimum number of photographs of one camera for fitting the eight parameters of OPENCV.

For a phone's distorted photographs, the reprojection error is 0.477 px with OPENCV and 0.493 px with SIMPLE_RADIAL.
"""
SEQUENTIAL_OVERLAP = 12
"""Number of photographs before and after a photograph that sequential matching pairs with it. It also pairs photographs
that are 2^n apart."""


class Worker:
    """One reconstruction from photographs. `run` calls the methods for its stages in order.

    task: see `sfm.reconstruct.sfm_task`. "photos" and "work" are folders. Each of "groups" lists the names of the
        photographs of one camera.
    channel: stream for the answers to the parent.
    """

    def __init__(self, task: dict[str, Any], channel: TextIO) -> None:
        self.task, self.channel = task, channel
        self.photos, self.work = Path(task["photos"]), Path(task["work"])
        self.database = self.work / "database.db"
        self.count = sum(map(len, task["groups"]))

    @property
    def reproducible_threads(self) -> int:
        """Number of threads of the stages whose results depend on it; see MAX_SINGLE_THREAD_PHOTOS."""
        threads: int = self.task["threads"]
        return 1 if self.count <= MAX_SINGLE_THREAD_PHOTOS else threads

    def say(self, **message: Any) -> None:
        print(json.dumps(message), file=self.channel, flush=True)

    def run(self) -> None:
        pycolmap.set_random_seed(self.task["seed"])
        self.extract()
        renumber_by_name(self.database)
        given = focal_lengths.from_exif(self.database)
        self.match()
        models = self.map(relaxed=False)
        if max((model.num_reg_images() for model in models.values()), default=0) < 0.6 * self.count:
            # The cameras may be close together, or there may be few features: try again with lower thresholds.
            models |= self.map(relaxed=True)
        if not models:
            self.say(failure=self.evidence())
            return
        best = max(models, key=lambda path: models[path].num_reg_images())  # models are not sorted by size
        self.undistort(best)
        model = models[best]
        registered = sorted(model.images[image_id].name for image_id in model.reg_image_ids())
        self.say(
            result={
                "registered": registered,
                "points": model.num_points3D(),
                "mean_reprojection_error": model.compute_mean_reprojection_error(),
                "pycolmap": pycolmap.__version__,
                "focal_lengths": focal_lengths.compared(model, given),
            }
        )

    def extract(self) -> None:
        """Extract SIFT features of every photograph into the database, with one camera for each group."""
        self.say(stage="features", total=self.count)
        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu = False
        options.num_threads = self.task["threads"]
        options.max_image_size = self.task["max_image_size"]
        options.sift.max_num_features = self.task["max_features"]
        singles = [names[0] for names in self.task["groups"] if len(names) == 1]
        batches = [(names, pycolmap.CameraMode.SINGLE) for names in self.task["groups"] if len(names) > 1]
        if singles:  # in one call, as only the photographs of one call are processed in parallel
            batches.append((singles, pycolmap.CameraMode.PER_IMAGE))
        for names, mode in batches:
            model = self.task["camera_model"]
            if model == "auto":
                shared = mode == pycolmap.CameraMode.SINGLE and len(names) >= MIN_OPENCV_PHOTOS
                model = "OPENCV" if shared else "SIMPLE_RADIAL"
            reader = pycolmap.ImageReaderOptions()
            reader.camera_model = model
            if self.task["masks"]:
                reader.mask_path = self.work / "masks"
            pycolmap.extract_features(
                database_path=self.database,
                image_path=self.photos,
                image_names=names,
                camera_mode=mode,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )

    def match(self) -> None:
        """Match features of all pairs, or of neighbours in the order of names, and verify them by epipolar geometry."""
        options = pycolmap.FeatureMatchingOptions()
        options.use_gpu = False
        options.num_threads = self.reproducible_threads
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = self.task["seed"]
        if self.task["sequential"]:
            self.say(stage="matches", total=None)
            pairing = pycolmap.SequentialPairingOptions()
            pairing.overlap = SEQUENTIAL_OVERLAP
            match = partial(pycolmap.match_sequential, pairing_options=pairing)
        else:
            self.say(stage="matches", total=self.count * (self.count - 1) // 2)
            match = pycolmap.match_exhaustive
        match(
            database_path=self.database,
            matching_options=options,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )

    def map(self, *, relaxed: bool) -> dict[Path, pycolmap.Reconstruction]:
        """Recover camera poses and points by incremental mapping. Returns all models, by their folders.

        relaxed: accept smaller triangulation angles and fewer matches than by default.
        """
        self.say(stage="cameras again" if relaxed else "cameras", total=self.count)
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = self.reproducible_threads
        options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = self.task["seed"]
        options.min_model_size = 3
        if relaxed:
            options.mapper.init_min_tri_angle = 4.0
            options.mapper.init_max_forward_motion = 1.0
            options.mapper.init_min_num_inliers = 50
            options.mapper.abs_pose_min_num_inliers = 15
            options.mapper.filter_min_tri_angle = 0.8
            options.triangulation.min_angle = 1.0
        output = self.work / ("sparse-relaxed" if relaxed else "sparse")
        output.mkdir()
        placed = 2

        def count_one() -> None:
            nonlocal placed
            placed += 1
            self.say(done=min(placed, self.count))

        models: dict[int, pycolmap.Reconstruction] = pycolmap.incremental_mapping(
            database_path=self.database,
            image_path=self.photos,
            output_path=output,
            options=options,
            next_image_callback=count_one,
        )
        return {output / str(index): model for index, model in models.items()}

    def undistort(self, model: Path) -> None:
        """Resample the registered photographs to pinhole cameras, in the layout that COLMAP's readers expect."""
        self.say(stage="undistorting", total=None)
        flat, result = self.work / "undistorted", self.work / "result"
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

    def evidence(self) -> dict[str, Any]:
        """Return counts of features and matches, for the message about a failed reconstruction."""
        with sqlite3.connect(self.database) as connection:
            features = [row[0] for row in connection.execute("SELECT rows FROM keypoints")]
            matches = [row[0] for row in connection.execute("SELECT rows FROM two_view_geometries")]
        return {
            "features": int(statistics.median(features)) if features else 0,
            "pairs": len(matches),
            "matched": sum(rows > 0 for rows in matches),
            "matches": max(matches, default=0),
        }


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


def renumber_by_name(database: Path) -> None:
    """Renumber the database's images, frames, cameras and rigs in the order of the images' names.

    Several threads process photographs and number them as they finish, in varying order. The numbers decide the order
    of all later work, and thus the last bits of the result.
    """
    connection = sqlite3.connect(database)
    with connection:
        rows = connection.execute(
            "SELECT i.image_id, d.frame_id, i.camera_id, f.rig_id FROM images i "
            "JOIN frame_data d ON d.data_id = i.image_id JOIN frames f ON f.frame_id = d.frame_id ORDER BY i.name"
        ).fetchall()
        images, frames, cameras, rigs = (_ranks([row[column] for row in rows]) for column in range(4))
        for table, column, ranks in (
            ("images", "image_id", images),
            ("keypoints", "image_id", images),
            ("descriptors", "image_id", images),
            ("frame_data", "data_id", images),
            ("pose_priors", "corr_data_id", images),
            ("frames", "frame_id", frames),
            ("frame_data", "frame_id", frames),
            ("cameras", "camera_id", cameras),
            ("images", "camera_id", cameras),
            ("rigs", "ref_sensor_id", cameras),
            ("frame_data", "sensor_id", cameras),
            ("pose_priors", "corr_sensor_id", cameras),
            ("rigs", "rig_id", rigs),
            ("frames", "rig_id", rigs),
        ):
            # Renumber in two steps, by way of unused numbers, as the values of these columns must be unique.
            far = 1 << 30
            connection.executemany(
                f"UPDATE {table} SET {column} = ? WHERE {column} = ?",  # noqa: S608 - names from the list above
                [(new + far, old) for old, new in ranks.items()],
            )
            connection.execute(f"UPDATE {table} SET {column} = {column} - {far} WHERE {column} >= {far}")  # noqa: S608
    connection.close()


def _ranks(numbers: Sequence[int]) -> dict[int, int]:
    """Return the rank of each number, from 1, in the order of first occurrence."""
    return {number: place for place, number in enumerate(dict.fromkeys(numbers), start=1)}


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
