# SPDX-License-Identifier: Apache-2.0
"""Count a frame's work in waves of 32 neighbouring Gaussians, whose items run in step. A wave has as many rounds as the
item with the most, and takes a branch if one of its items does."""

from __future__ import annotations

from typing import Any

import numpy as np
from gpu_lists import OWN_BOX, SMALL_BOX
from numpy.typing import NDArray

from clsplat.bench.workload import Subject
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.layouts.columns import SPLAT, TILE
from clsplat.reference.project import LOW_PASS_PX2, rotation_matrices

WAVE = 32
REFINE_FROM, FORESHORTENED = 64.0, 256.0
"""Ratios above which `refine` runs: place.h."""
_SLACK = 0.01
"""Pixels by which an ellipse counts as larger: TILE_SLACK in tile.h."""
_MOST_REFINED = 1 << 20
"""Gaussians for which `refined` holds its matrices at a time."""


def _in_waves(values: NDArray[Any]) -> NDArray[Any]:
    """Values (n, ...) by waves: (waves, WAVE, ...). The last wave is filled up with zeros."""
    padded = np.pad(values, ((0, -len(values) % WAVE), *((0, 0),) * (values.ndim - 1)))
    return padded.reshape(-1, WAVE, *values.shape[1:])


def _longest(values: NDArray[Any]) -> float:
    """Mean over the waves of the largest value in a wave."""
    return round(float(_in_waves(values).max(1).mean()), 3)


def refined(subject: Subject) -> NDArray[np.bool_]:
    """Mask (n,) of the Gaussians in front of the camera whose projection `refine` computes anew (gaussian.h)."""
    camera, gaussians, found = subject.camera, subject.gaussians, []
    for begin in range(0, len(gaussians), _MOST_REFINED):
        means, quaternions, log_scales = (
            array[begin : begin + _MOST_REFINED].astype(np.float64)
            for array in (gaussians.means, gaussians.quaternions, gaussians.log_scales)
        )
        with np.errstate(all="ignore"):  # behind the camera
            at = means @ camera.rotation.T + camera.translation
            jacobian = camera.model.projected(camera, at).jacobian
            axes = jacobian @ camera.rotation @ rotation_matrices(quaternions)
            scales = np.exp(log_scales)
            one, other = np.moveaxis(axes * scales[:, None], 1, 0)
            trace = (one * one).sum(1) + (other * other).sum(1) + 2 * LOW_PASS_PX2
            crossed = np.cross(one, other)
            det = (crossed * crossed).sum(1) + LOW_PASS_PX2 * (trace - LOW_PASS_PX2)
            across = jacobian[:, 0, 0] ** 2 + jacobian[:, 1, 1] ** 2
            thin = scales.max(1) ** 2 * across * trace > REFINE_FROM**2 * det
            foreshortened = (across[:, None] > FORESHORTENED**2 * (axes * axes).sum(1)).any(1)
        found.append((thin | foreshortened) & (at[:, 2] > camera.near) & (at[:, 2] < camera.far))
    return np.concatenate(found)


def _cells(low: NDArray[Any], high: NDArray[Any], count: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """The first tile of an extent, and the one past its last: first_cell and end_cell in tile.h.

    low, high: ends of the extent in pixels.
    count: number of the image's tiles along the axis.
    """
    first = np.clip(np.ceil((low - _SLACK + 0.5) / TILE - 1), 0, count)
    end = np.clip(np.floor((high + _SLACK - 0.5) / TILE + 1), 0, count)
    return first, np.maximum(end, first)


def spans(splats: NDArray[Any], listed: NDArray[Any], tiles: tuple[int, int]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Numbers of rows and of tiles of each Gaussian's box; both 0 for Gaussians that are in no list.

    splats: of each Gaussian. listed: True for those in lists. tiles: number across and down.
    """
    with np.errstate(all="ignore"):  # culled Gaussians have arbitrary values
        field = dict(zip(SPLAT, splats.T.astype(np.float64), strict=False))
        sides = [
            _cells(at - field[half], at + field[half], count)
            for at, half, count in (
                (field["PIXEL_X"] + field["SUB_X"], "HALF_W", tiles[0]),
                (field["PIXEL_Y"] + field["SUB_Y"], "HALF_H", tiles[1]),
            )
        ]
        columns, rows = (np.where(listed, end - first, 0).astype(np.int64) for first, end in sides)
    return rows, rows * columns


def widths(splats: NDArray[Any], rows: NDArray[Any], boxes: NDArray[Any], tiles: tuple[int, int]) -> NDArray[Any]:
    """Number of tiles that a Gaussian's ellipse reaches in each row of its box, (n, most rows): tile_span in tile.h.

    rows, boxes: from `spans`.
    """
    with np.errstate(all="ignore"):
        f = dict(zip(SPLAT, splats.T.astype(np.float64), strict=False))
        mx, my = f["PIXEL_X"] + f["SUB_X"], f["PIXEL_Y"] + f["SUB_Y"]
        first, _ = _cells(my - f["HALF_H"], my + f["HALF_H"], tiles[1])
        budget = f["LOG2O"] - np.log2(RasterizerConfig().alpha_min)
        tangent = -f["L12"] * f["L11"] / (f["L22"] ** 2 + f["L12"] ** 2) * f["HALF_W"]

    def edge(d0: NDArray[Any], d1: NDArray[Any]) -> NDArray[Any]:
        dy = np.where(tangent < d0, d0, d1)
        rest = np.maximum(budget - (f["L22"] * dy) ** 2, 0)
        inside = (tangent >= d0) & (tangent <= d1)
        right: NDArray[Any] = np.where(inside, f["HALF_W"], (-f["L12"] * dy + np.sqrt(rest)) / f["L11"])
        return right

    found = np.zeros((len(splats), int(rows.max(initial=0))), np.int32)
    whole = boxes // np.maximum(rows, 1)
    for row in range(found.shape[1]):
        with np.errstate(all="ignore"):
            d0 = np.clip((first + row) * TILE + 0.5 - _SLACK - my, -f["HALF_H"], f["HALF_H"])
            d1 = np.clip((first + row + 1) * TILE - 0.5 + _SLACK - my, -f["HALF_H"], f["HALF_H"])
            begin, end = _cells(mx - edge(-d1, -d0), mx + edge(d0, d1), tiles[0])
            reached = np.nan_to_num(end - begin).astype(np.int32)
        found[:, row] = np.where(row < rows, np.where(boxes > SMALL_BOX, reached, whole), 0)
    return found


def waves_in(
    refines: NDArray[np.bool_], splats: NDArray[Any], pairs: NDArray[Any], tiles: tuple[int, int]
) -> dict[str, Any]:
    """Keys of a frame's row: the fields of `gpu_lists.Boxes`, where `wide` is a fraction of all Gaussians.

    refines: from `refined`.
    splats, pairs: splat, and number of pairs, of each Gaussian.
    tiles: number of tiles across and down.
    """
    rows, boxes = spans(splats, pairs > 0, tiles)
    tested, wide = boxes > SMALL_BOX, boxes > OWN_BOX
    by_depth = np.flatnonzero(pairs > 0)
    by_depth = by_depth[np.argsort(splats[by_depth, SPLAT.index("DEPTH")], kind="stable")]
    of_row = widths(splats, rows, boxes, tiles)

    def rounds(values: NDArray[Any]) -> float:
        """Rounds over the tiles of a wave's rows, on average: in each row, those of the item with the most tiles."""
        return round(float(_in_waves(values).max(1).sum(1).mean()), 3)

    number = max(int(wide.sum()), 1)
    return {
        "refined": round(float(_in_waves(refines).any(1).mean()), 4),
        "wave_rows": _longest(np.where(wide, 0, rows)),
        "wave_tested": _longest(np.where(tested & ~wide, rows, 0)),
        "wave_tiles": rounds(np.where(wide[:, None], 0, of_row)),
        "own_pairs": round(float(_in_waves(np.where(wide, 0, pairs)).sum(1).mean()), 3),
        "all_tested": _longest(np.where(tested, rows, 0)),
        "all_pairs": _longest(pairs),
        "sorted_rows": _longest(rows[by_depth]),
        "sorted_tested": _longest(np.where(tested, rows, 0)[by_depth]),
        "sorted_tiles": rounds(of_row[by_depth]),
        "wide": round(float(wide.mean()), 6),
        "wide_rows": round(float(rows[wide].sum()) / number, 3),
        "wide_columns": round(float((boxes[wide] / rows[wide]).sum()) / number, 3),
    }
