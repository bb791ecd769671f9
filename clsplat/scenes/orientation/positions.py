# SPDX-License-Identifier: Apache-2.0
"""Fit of a scene's cameras to the GPS positions of its photographs, in metres.

Altitudes from GPS are less exact than positions on the map: a compact camera's drifted by 100 metres in a flight. So
scale and north come from a fit on the map, for a known up direction. Up comes from GPS only if the altitudes fit too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.errors import InputError, examples
from clsplat.images.geotags import GpsPosition
from clsplat.models.edit import moved
from clsplat.scenes.orientation.upright import MeasuredUp, axes_of

MIN_GPS_PHOTOS = 3
"""Minimum number of photographs with GPS positions for a fit."""
GPS_FIT_TRIALS = 2000
"""Number of random pairs of photographs that the robust fit on the map tries."""
GPS_OUTLIER_SIGMAS = 4.0
"""Positions are outliers if their residual is over this multiple of sigma: 1.4826 times the median residual. For normal
errors on the map, the limit is 7 standard deviations along an axis."""
MAX_GPS_RESIDUAL_SHARE = 0.5
"""Largest residual (root mean square) of a fit that is accepted, relative to the spread of the positions."""
MAX_GPS_ERROR_METRES = 30.0
"""Largest error of an inlier in the fit that gives the up direction. A phone between buildings is 10 to 20 m off."""
MAX_GPS_TILT_RADIANS = np.deg2rad(1.0)
"""Largest standard error, in radians, of an up direction from GPS positions that is used."""


@dataclass(frozen=True, eq=False)
class MapFit:
    """A fit of the cameras to positions on the map, for a known up direction.

    metres: length of a world unit in metres.
    north: (3,), the direction of north in the world, at a right angle to up.
    names: photographs whose positions are used (inliers).
    doubtful: the other photographs, with the distance in metres of each position from the fitted camera.
    residual: distance (root mean square) of the inliers from the fitted cameras on the map, in metres.
    spread: distance (root mean square) of the inliers from their mean, in metres.
    """

    metres: float
    north: Float64
    names: tuple[str, ...]
    doubtful: Mapping[str, float]
    residual: float
    spread: float

    @property
    def error(self) -> float:
        """Relative standard error of `metres`, if the positions have independent errors."""
        return self.residual / (self.spread * math.sqrt(len(self.names)))

    @property
    def note(self) -> str:
        """The fit in words: number of positions, residual and extent."""
        return (
            f"GPS positions of {len(self.names):,} photographs, which fit within {self.residual:.2g} m on the map over "
            f"a spread of {self.spread:.3g} m (root mean squares), which gives the scale to {100 * self.error:.2g} %"
        )

    @property
    def doubt(self) -> str:
        """A warning that names the photographs whose positions are not used; "" if all are used."""
        if not self.doubtful:
            return ""
        named = examples(f"{name} by {metres:,.0f} m" for name, metres in self.doubtful.items())
        return f"GPS of {len(self.doubtful):,} photograph(s) is far from the cameras and not used: {named}"


def fit_map(cameras: Mapping[str, Camera], positions: Mapping[str, GpsPosition], up: Float64) -> MapFit:
    """Fit the cameras to the photographs' positions on the map, robustly against wrong positions.

    up: (3,), unit vector in the world.
    Raises InputError for too few positions, and for positions that do not fit the cameras. Callers put the scene's name
    before the message.
    """
    names = sorted(name for name in positions if name in cameras)
    if len(names) < MIN_GPS_PHOTOS:
        raise InputError(
            f"{len(names)} of {len(cameras):,} photographs have a GPS position in their EXIF, expected at least "
            f"{MIN_GPS_PHOTOS}; give a known length instead"
        )
    enu = _enu([positions[name] for name in names], _middle([positions[name] for name in names]))
    axes = axes_of(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    places = np.stack([cameras[name].position for name in names]) @ axes.T
    here, there = places[:, 0] + 1j * places[:, 2], enu[:, 0] + 1j * enu[:, 1]  # x east, z north
    factor, offset, good = _robust(here, there)
    distances = np.abs(factor * here + offset - there)
    residual = float(np.sqrt(np.mean(distances[good] ** 2)))
    spread = float(np.std(there[good]))
    if (
        good.sum() < max(MIN_GPS_PHOTOS, len(names) / 2)
        or not residual + spread > 0
        or (residual > MAX_GPS_RESIDUAL_SHARE * spread)
    ):
        raise InputError(
            f"the GPS positions of {int(good.sum()):,} of {len(names):,} photographs fit the cameras within "
            f"{residual:.2g} m, over a spread of {spread:.2g} m; expected more than half of them, and a spread of "
            "several times the error; give a known length instead"
        )
    doubtful = {name: float(distances[i]) for i, name in enumerate(names) if not good[i]}
    believed = tuple(name for i, name in enumerate(names) if good[i])
    north = 1j * np.conj(factor) / abs(factor)  # the direction in the cameras' world that the fit turns to north
    return MapFit(
        abs(factor), np.asarray(north.real * axes[0] + north.imag * axes[2]), believed, doubtful, residual, spread
    )


def _robust(
    here: np.ndarray[tuple[int], np.dtype[np.complex128]], there: np.ndarray[tuple[int], np.dtype[np.complex128]]
) -> tuple[complex, complex, np.ndarray[tuple[int], np.dtype[np.bool_]]]:
    """Fit there = factor * here + offset by least median of squares (Rousseeuw 1984), then by least squares.

    here, there: (n,), places in a plane as complex numbers.
    Returns factor, offset, and a mask (n,) of the places that fit.
    """
    rng = np.random.default_rng(0)
    pairs = rng.integers(len(here), size=(GPS_FIT_TRIALS, 2))
    apart = here[pairs[:, 1]] - here[pairs[:, 0]]
    pairs, apart = pairs[np.abs(apart) > 0], apart[np.abs(apart) > 0]
    factor, offset, best = 0j, complex(np.mean(there)), np.inf
    for (first, second), step in zip(pairs, apart, strict=True):
        tried = (there[second] - there[first]) / step
        off = float(np.median(np.abs(tried * (here - here[first]) + there[first] - there)))
        if off < best:
            factor, offset, best = complex(tried), complex(there[first] - tried * here[first]), off
    sigma = best if np.isfinite(best) else 0.0
    good = np.ones(len(here), np.bool_)
    for _ in range(5):
        distances = np.abs(factor * here + offset - there)
        sigma = max(1.4826 * float(np.median(distances)), 1e-9)
        good = distances <= GPS_OUTLIER_SIGMAS * sigma
        middle, target = here[good].mean(), there[good].mean()
        power = float(np.sum(np.abs(here[good] - middle) ** 2))
        if power == 0:
            break
        factor = complex(np.sum(np.conj(here[good] - middle) * (there[good] - target)) / power)
        offset = complex(target - factor * middle)
    return factor, offset, good


def up_from_gps(cameras: Mapping[str, Camera], positions: Mapping[str, GpsPosition]) -> MeasuredUp | None:
    """Return the up direction of a fit to positions with altitudes; None if they do not give it to within a degree.

    The errors of GPS are small enough only for a wide capture, such as a drone's.
    """
    import pycolmap

    known = {name: at for name, at in sorted(positions.items()) if name in cameras and at.altitude is not None}
    if len(known) < max(MIN_GPS_PHOTOS + 1, len(cameras) / 2):
        return None
    enu = _enu(list(known.values()), _middle(list(known.values())))
    places = np.stack([cameras[name].position for name in known])
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = MAX_GPS_ERROR_METRES, 0
    found = pycolmap.estimate_sim3d_robust(places, enu, options)
    if found is None or (good := np.asarray(found["inlier_mask"])).sum() < 0.8 * len(known):
        return None
    fit = pycolmap.estimate_sim3d(places[good], enu[good])
    if fit is None:
        return None
    matrix = np.asarray(fit.matrix(), np.float64)
    off = moved(places[good], np.vstack([matrix, np.eye(4)[3:]])) - enu[good]
    error = float(np.sqrt(np.mean(off**2)))
    # a plane through n places, with the width w across their narrow side, is tilted by about error / (w sqrt(n))
    width = float(np.linalg.svd(enu[good] - enu[good].mean(axis=0), compute_uv=False)[1])
    if not width > 0 or np.arctan2(error, width) > MAX_GPS_TILT_RADIANS:
        return None
    up = matrix[2, :3] / np.linalg.norm(matrix[2, :3])
    return MeasuredUp(up, f"GPS positions of {int(good.sum()):,} photographs, within {error:.2g} m")


def globe_position(
    fit: MapFit, positions: Mapping[str, GpsPosition], places: Mapping[str, Float64]
) -> tuple[float, ...]:
    """Return latitude and longitude in degrees and altitude in metres of the world's origin.

    places: camera positions (3,) by the photographs' names, in a world in metres with x east, y down and z north.
    A position without an altitude counts as on the ellipsoid, at 0 m.
    """
    import pycolmap

    known = [positions[name] for name in fit.names]
    origin = _middle(known)
    away = np.median(_enu(known, origin) - np.stack([_east_north_up(places[name]) for name in fit.names]), axis=0)
    latitude, longitude, altitude = pycolmap.GPSTransform().enu_to_ellipsoid(np.asarray(away)[None], *origin)[0]
    return float(latitude), float(longitude), float(altitude)


def _east_north_up(place: Float64) -> Float64:
    return np.array([place[0], place[2], -place[1]])


def _middle(positions: list[GpsPosition]) -> tuple[float, float, float]:
    latitude, longitude, altitude = np.median([_triple(at) for at in positions], axis=0).tolist()
    return latitude, longitude, altitude


def _enu(positions: list[GpsPosition], origin: tuple[float, float, float]) -> Float64:
    """Return positions (n, 3) in metres east, north and up of an origin on the ellipsoid."""
    import pycolmap

    globe = np.array([_triple(at) for at in positions], np.float64)
    return np.asarray(pycolmap.GPSTransform().ellipsoid_to_enu(globe, *origin), np.float64)


def _triple(at: GpsPosition) -> tuple[float, float, float]:
    return at.latitude, at.longitude, at.altitude or 0.0
