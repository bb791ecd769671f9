# SPDX-License-Identifier: Apache-2.0
"""ALIKED features of photographs by an ONNX network, with onnxruntime, and their matching.

pycolmap's wheels are built without ONNX, so clsplat runs the network and writes the features and matches into COLMAP's
database itself. The network is as the COLMAP project publishes it.

Inputs: `image` (1, 3, H, W), RGB from 0 to 1, H and W multiples of 32; `max_keypoints`, int64; `min_score`, float32.
Outputs: `keypoints` (1, K, 2), from -1 to 1 between the centres of the outermost pixels; `descriptors` (1, K, D);
  `scores` (1, K).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from clsplat.errors import examples
from clsplat.scenes.sfm.pipeline import database as sfm_database
from clsplat.scenes.sfm.pipeline.features import camera_batches
from clsplat.scenes.sfm.pipeline.matching import verification_cameras, verification_options
from clsplat.scenes.sfm.pipeline.photo_pairs import Pair

ALIKED_INPUTS = ("image", "max_keypoints", "min_score")
"""Names of the network's inputs."""
ALIKED_OUTPUTS = ("keypoints", "descriptors", "scores")
"""Names of the network's outputs."""
ALIKED_MULTIPLE_PX = 32
"""The network takes pictures whose width and height are multiples of this number of pixels."""
MAX_ALIKED_FEATURES = 4096
"""Maximum number of features in a photograph. Every two features of a pair are compared, so this bounds the time."""
MIN_ALIKED_SCORE = 0.2
"""Minimum score of a feature, from 0 to 1."""
MIN_ALIKED_COSINE = 0.8
"""Minimum cosine between the descriptors of two features that match."""


class WeightsError(Exception):
    """Error about a file that is not the expected network. Its text follows the file's name in the message."""


class AlikedNetwork:
    """An ALIKED network. Each call takes one thread, so that results do not depend on the number of threads."""

    def __init__(self, weights: Path) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4
        try:
            self._session = onnxruntime.InferenceSession(str(weights), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # noqa: BLE001 - onnxruntime's errors share no class
            raise WeightsError(f"is not an ONNX network: {str(error).splitlines()[0]}") from None
        inputs = [entry.name for entry in self._session.get_inputs()]
        outputs = [entry.name for entry in self._session.get_outputs()]
        if set(inputs) != set(ALIKED_INPUTS) or not set(ALIKED_OUTPUTS) <= set(outputs):
            raise WeightsError(
                f"is an ONNX network with the inputs {examples(inputs)} and the outputs {examples(outputs)}, expected "
                f"{', '.join(ALIKED_INPUTS)} and {', '.join(ALIKED_OUTPUTS)}, as in COLMAP's aliked-n16rot.onnx"
            )

    def features(self, picture: NDArray[np.uint8], most: int) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the keypoints (K, 2) of a picture (H, W, 3) in COLMAP's pixels, and their unit descriptors (K, D).

        most: maximum number of features.
        """
        height, width = picture.shape[:2]
        pads = [(0, -side % ALIKED_MULTIPLE_PX) for side in (height, width)]
        padded = np.pad(picture, [*pads, (0, 0)], mode="edge").astype(np.float32) / 255
        given = {
            "image": padded.transpose(2, 0, 1)[None],
            "max_keypoints": np.array(most, np.int64),
            "min_score": np.array(MIN_ALIKED_SCORE, np.float32),
        }
        try:
            points, descriptors = self._session.run(list(ALIKED_OUTPUTS[:2]), given)
            pixels = (points[0].reshape(-1, 2) + 1) / 2 * (np.array(padded.shape[1::-1]) - 1) + 0.5
            rows = descriptors[0].reshape(len(pixels), -1)
        except Exception as error:  # noqa: BLE001 - as above; a network of other shapes fails here
            raise WeightsError(f"cannot be run on a photograph: {str(error).splitlines()[0]}") from None
        inside = np.isfinite(pixels).all(axis=1) & (pixels >= 0).all(axis=1) & (pixels < (width, height)).all(axis=1)
        rows = np.nan_to_num(rows[inside].astype(np.float32))
        lengths = np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
        return pixels[inside].astype(np.float32), rows / lengths


def extract_aliked(database: Path, task: dict[str, Any], network: AlikedNetwork, done: Callable[[int], None]) -> None:
    """Extract the ALIKED features of every photograph into the database.

    task: see `sfm.reconstruct.sfm_task`. done: function that is called with the number of finished photographs.
    """
    pycolmap.Database.open(database).close()  # makes the file
    for names, mode, reader in camera_batches(task["groups"], task["camera_model"]):
        pycolmap.import_images(
            database_path=database, image_path=task["photos"], camera_mode=mode, image_names=names, options=reader
        )

    def work(name: str) -> tuple[NDArray[Any], NDArray[Any]]:
        return _features_of(name, task, network)

    images = sfm_database.image_names(database)
    with ThreadPoolExecutor(task["threads"]) as pool, pycolmap.Database.open(database) as opened:
        for count, (image, (points, rows)) in enumerate(zip(images, pool.map(work, images.values()), strict=True), 1):
            opened.write_keypoints(image, points)
            kind = pycolmap.FeatureExtractorType.ALIKED_N16ROT
            opened.write_descriptors(image, pycolmap.FeatureDescriptors(kind, rows.view(np.uint8)))
            done(count)


def _features_of(name: str, task: dict[str, Any], network: AlikedNetwork) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return keypoints and descriptors of a photograph, without the features in black pixels of its mask."""
    bitmap = pycolmap.Bitmap.read(Path(task["photos"]) / name, as_rgb=True)
    size = np.array([bitmap.width, bitmap.height])
    scale = min(1.0, task["max_image_size"] / size.max())
    if scale < 1:
        bitmap.rescale(*(int(side) for side in np.maximum(1, np.rint(size * scale))))
    points, rows = network.features(bitmap.to_array(), min(task["max_features"], MAX_ALIKED_FEATURES))
    points = points * (size / np.array([bitmap.width, bitmap.height], np.float32)).astype(np.float32)
    if name in task["masks"]:
        mask = pycolmap.Bitmap.read(Path(task["work"]) / "masks" / f"{name}.png", as_rgb=False).to_array()
        at = np.minimum(points.astype(int), size - 1)
        kept = mask.reshape(size[1], size[0], -1)[at[:, 1], at[:, 0], 0] > 0
        points, rows = points[kept], rows[kept]
    return np.ascontiguousarray(points), np.ascontiguousarray(rows)


def match_aliked(
    database: Path, pairs: Sequence[Pair], *, threads: int, seed: int, with_focal: bool, done: Callable[[int], None]
) -> None:
    """Match features that are each other's nearest, in pairs of photographs, and verify the matches.

    pairs: numbers of photographs in the database. threads: number of threads of the verification.
    with_focal: as in `matching.verification_cameras`.
    done: function that is called with the number of pairs that are matched.
    """
    with pycolmap.Database.open(database) as opened:
        rows = {
            image: opened.read_descriptors(image).data.view(np.float32) for image in sfm_database.image_names(database)
        }
        for count, (one, two) in enumerate(pairs, 1):
            opened.write_matches(one, two, mutual_matches(rows[one], rows[two]))
            done(count)
    options = pycolmap.GeometricVerifierOptions()
    options.num_threads = threads
    with verification_cameras(database, with_focal=with_focal):
        pycolmap.geometric_verification(
            database_path=database, verifier_options=options, two_view_geometry_options=verification_options(seed)
        )


def mutual_matches(one: NDArray[Any], two: NDArray[Any]) -> NDArray[np.uint32]:
    """Return the index pairs (M, 2) of unit descriptors (K, D) and (L, D) that are each other's nearest."""
    if not len(one) or not len(two):
        return np.zeros((0, 2), np.uint32)
    cosines = one @ two.T
    nearest, back = cosines.argmax(axis=1), cosines.argmax(axis=0)
    index = np.arange(len(one))
    good = (back[nearest] == index) & (cosines[index, nearest] >= MIN_ALIKED_COSINE)
    return np.stack([index[good], nearest[good]], axis=1).astype(np.uint32)
