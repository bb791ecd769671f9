# SPDX-License-Identifier: Apache-2.0
"""COLMAP's database of a reconstruction: images are numbered and renamed, features and GPS positions are read."""

from __future__ import annotations

import contextlib
import sqlite3
import statistics
from collections.abc import Iterator, Sequence
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

GPS_ALTITUDE_M = 0.0
"""Altitude in metres at which horizontal positions are computed. EXIF's altitudes are often wrong by 100 m."""

GPS_MAP_SIGMA_M, GPS_ALTITUDE_SIGMA_M = 5.0, 50.0
"""Standard deviations in metres of GPS positions on the map, and of their altitudes, as priors of the cameras."""


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


def image_names(database: Path) -> dict[int, str]:
    """Return the names of the photographs, keyed and ordered by their numbers."""
    with contextlib.closing(sqlite3.connect(database)) as connection:
        return dict(connection.execute("SELECT image_id, name FROM images ORDER BY image_id").fetchall())


def rename_images(database: Path, names: dict[int, str]) -> None:
    """Give the photographs other names, keyed by their numbers."""
    with contextlib.closing(sqlite3.connect(database)) as connection, connection:
        # A name may be the present name of another photograph, and names must be unique.
        connection.execute("UPDATE images SET name = '/' || image_id")
        connection.executemany(
            "UPDATE images SET name = ? WHERE image_id = ?", [(new, at) for at, new in names.items()]
        )


@contextlib.contextmanager
def separate_cameras(database: Path) -> Iterator[None]:
    """Give every photograph whose camera has no known focal length a camera of its own until the context ends."""
    added = 1 << 30  # camera numbers from here on are unused
    with contextlib.closing(sqlite3.connect(database)) as connection, connection:
        before = connection.execute(
            "SELECT i.camera_id, i.image_id FROM images i JOIN cameras c USING (camera_id) "
            "WHERE c.prior_focal_length = 0"
        ).fetchall()
        connection.executemany(
            "INSERT INTO cameras SELECT ?, model, width, height, params, 0 FROM cameras WHERE camera_id = ?",
            [(added + image, camera) for camera, image in before],
        )
        connection.executemany(
            "UPDATE images SET camera_id = ? WHERE image_id = ?", [(added + image, image) for _, image in before]
        )
    try:
        yield
    finally:
        with contextlib.closing(sqlite3.connect(database)) as connection, connection:
            connection.executemany("UPDATE images SET camera_id = ? WHERE image_id = ?", before)
            connection.execute("DELETE FROM cameras WHERE camera_id >= ?", (added,))


def largest_descriptors(database: Path, ids: Sequence[int], most: int) -> list[NDArray[Any]]:
    """Return the descriptors (features, dimensions) of the largest features of each photograph.

    ids: numbers of the photographs. most: maximum number of features in a photograph.
    """
    found = []
    with contextlib.closing(sqlite3.connect(database)) as connection:
        for image in ids:
            points = _array(connection, "keypoints", image, np.dtype(np.float32))
            learned = _cell(connection, "SELECT type FROM descriptors WHERE image_id = ?", image) not in (None, 0)
            rows = _array(connection, "descriptors", image, np.dtype(np.float32 if learned else np.uint8))
            found.append(rows[_largest_first(points)[:most]])
    return found


def keep_largest(database: Path, most: int) -> None:
    """Delete the smallest features of every photograph that has more than `most`.

    pycolmap's own limit leaves out whole scales and counts a feature with two orientations once, so that photographs
    have up to 80 % more features than it allows.
    """
    with contextlib.closing(sqlite3.connect(database)) as connection, connection:
        over = connection.execute("SELECT image_id FROM keypoints WHERE rows > ?", (most,)).fetchall()
        for (image,) in over:
            points = _array(connection, "keypoints", image, np.dtype(np.float32))
            kept = np.sort(_largest_first(points)[:most])
            descriptors = _array(connection, "descriptors", image, np.dtype(np.uint8))
            for table, rows in (("keypoints", points), ("descriptors", descriptors)):
                connection.execute(
                    f"UPDATE {table} SET rows = ?, data = ? WHERE image_id = ?",  # noqa: S608 - names from the list above
                    (len(kept), rows[kept].tobytes(), image),
                )


def feature_counts(database: Path) -> dict[int, int]:
    """Return the number of features of each photograph, keyed and ordered by the photographs' numbers."""
    with contextlib.closing(sqlite3.connect(database)) as connection:
        query = "SELECT i.image_id, COALESCE(k.rows, 0) FROM images i LEFT JOIN keypoints k USING (image_id) ORDER BY 1"
        return dict(connection.execute(query).fetchall())


def feature_counts_and_sizes(database: Path) -> list[tuple[int, int, int]]:
    """Return the number of features, the width and the height in pixels of each photograph that has been processed."""
    with contextlib.closing(sqlite3.connect(database)) as connection:
        query = (
            "SELECT k.rows, c.width, c.height FROM keypoints k JOIN images i USING (image_id) "
            "JOIN cameras c USING (camera_id)"
        )
        return connection.execute(query).fetchall()


def camera_of(database: Path, name: str) -> int:
    """Return the number of the camera of a photograph."""
    with contextlib.closing(sqlite3.connect(database)) as connection:
        camera: int = connection.execute("SELECT camera_id FROM images WHERE name = ?", (name,)).fetchone()[0]
    return camera


def verified_matches(database: Path) -> dict[tuple[int, int], NDArray[np.uint32]]:
    """Return the verified matches (M, 2) of each pair that has some: indices of features in the first and the second.

    The key of a pair is the two photographs' numbers.
    """
    with contextlib.closing(sqlite3.connect(database)) as connection:
        rows = connection.execute("SELECT pair_id, data FROM two_view_geometries WHERE rows > 0 ORDER BY pair_id")
        return {
            pycolmap.pair_id_to_image_pair(pair): np.frombuffer(data, np.uint32).reshape(-1, 2) for pair, data in rows
        }


def cameras_without_focal_length(database: Path) -> list[pycolmap.Camera]:
    """Return the pinhole cameras, with or without distortion, for which EXIF gives no focal length."""
    with pycolmap.Database.open(database) as opened:
        cameras = opened.read_all_cameras()
    return [camera for camera in cameras if camera.is_perspective_pinhole() and not camera.has_prior_focal_length]


def fundamental_matrices(database: Path, camera: int) -> NDArray[np.float64]:
    """Return the fundamental matrices (N, 3, 3) of the pairs of photographs of one camera, except planar pairs."""
    uncalibrated = int(pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED)
    with contextlib.closing(sqlite3.connect(database)) as connection:
        images = {
            image for (image,) in connection.execute("SELECT image_id FROM images WHERE camera_id = ?", (camera,))
        }
        rows = connection.execute(
            "SELECT pair_id, F FROM two_view_geometries WHERE config = ? AND F IS NOT NULL ORDER BY pair_id",
            (uncalibrated,),
        )
        found = [
            np.frombuffer(data).reshape(3, 3)
            for pair, data in rows
            if images.issuperset(pycolmap.pair_id_to_image_pair(pair))
        ]
    return np.array(found).reshape(-1, 3, 3)


def with_focal_length(camera: pycolmap.Camera, focal: float) -> pycolmap.Camera:
    """Return the camera with a known focal length in pixels."""
    found, params = copy(camera), np.array(camera.params)
    params[camera.focal_length_idxs()] = focal
    found.params, found.has_prior_focal_length = params, True
    return found


def write_cameras(database: Path, cameras: Sequence[pycolmap.Camera]) -> None:
    """Write cameras in place of those with the same numbers."""
    with pycolmap.Database.open(database) as opened:
        for camera in cameras:
            opened.update_camera(camera)


def gps_positions(database: Path, ids: Sequence[int]) -> NDArray[np.float64]:
    """Return the photographs' GPS positions (N, 2) in metres to the east and north of the first that is known.

    Unknown positions are NaN.

    ids: numbers of the photographs.
    """
    place = {image: at for at, image in enumerate(ids)}
    degrees = np.full((len(ids), 3), np.nan)
    with pycolmap.Database.open(database) as opened:
        for prior in opened.read_all_pose_priors():
            if prior.coordinate_system == pycolmap.PosePriorCoordinateSystem.WGS84:
                degrees[place[prior.corr_data_id.id]] = (*prior.position[:2], GPS_ALTITUDE_M)
    known = np.flatnonzero(np.isfinite(degrees).all(axis=1))
    metres = np.full((len(ids), 2), np.nan)
    if len(known):
        metres[known] = pycolmap.GPSTransform().ellipsoid_to_enu(degrees[known], *degrees[known[0]])[:, :2]
    return metres


def weight_gps(database: Path) -> None:
    """Give the GPS positions the standard deviations above, and those without an altitude the median of the others."""
    with pycolmap.Database.open(database) as opened:
        system = pycolmap.PosePriorCoordinateSystem.WGS84
        priors = [prior for prior in opened.read_all_pose_priors() if prior.coordinate_system == system]
        altitudes = [prior.position[2] for prior in priors if np.isfinite(prior.position[2])]
        usual = statistics.median(altitudes) if altitudes else GPS_ALTITUDE_M
        for prior in priors:
            latitude, longitude, altitude = prior.position
            prior.position = np.array([latitude, longitude, altitude if np.isfinite(altitude) else usual])
            deviations = np.array([GPS_MAP_SIGMA_M, GPS_MAP_SIGMA_M, GPS_ALTITUDE_SIGMA_M])
            prior.position_covariance = np.diag(deviations**2)
            opened.update_pose_prior(prior)


def feature_evidence(database: Path) -> dict[str, Any]:
    """Return counts of features and matches, for the message about a failed reconstruction.

    Keys: "features" is the median number in a photograph, and "pairs" the number of pairs that were tried. "matched" is
    the number of pairs with verified matches, and "matches" the largest number of these in a pair.
    """
    with contextlib.closing(sqlite3.connect(database)) as connection:
        features = [row[0] for row in connection.execute("SELECT rows FROM keypoints")]
        matches = [row[0] for row in connection.execute("SELECT rows FROM two_view_geometries")]
    return {
        "features": int(statistics.median(features)) if features else 0,
        "pairs": len(matches),
        "matched": sum(rows > 0 for rows in matches),
        "matches": max(matches, default=0),
    }


def _cell(connection: sqlite3.Connection, query: str, image: int) -> Any:
    row = connection.execute(query, (image,)).fetchone()
    return row[0] if row else None


def _array(connection: sqlite3.Connection, table: str, image: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the array of a photograph in a table of the database, (0, 2) if there is none."""
    row = connection.execute(f"SELECT rows, data FROM {table} WHERE image_id = ?", (image,)).fetchone()  # noqa: S608
    if row is None or not row[0]:
        return np.zeros((0, 2), dtype)
    return np.frombuffer(row[1], dtype).reshape(row[0], -1)


def _largest_first(points: NDArray[Any]) -> NDArray[np.int64]:
    """Return the indices of keypoints (K, columns) by size, the largest first. Equal sizes keep their order."""
    # A keypoint has x, y and the affine shape (4 values), or x, y, scale and orientation, or x and y.
    sizes = np.abs(points[:, 2]) if points.shape[1] > 2 else np.zeros(len(points))
    if points.shape[1] == 6:
        sizes = np.hypot(points[:, 2], points[:, 4])
    return np.argsort(-sizes, kind="stable")


def _ranks(numbers: Sequence[int]) -> dict[int, int]:
    """Return the rank of each number, from 1, in the order of first occurrence."""
    return {number: place for place, number in enumerate(dict.fromkeys(numbers), start=1)}
