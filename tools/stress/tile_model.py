#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Make a large model for tests: copies of a model on a grid, with any number of Gaussians.

    python tools/stress/tile_model.py MODEL OUTPUT.ply --gaussians N [--sh-degree 3] [--up z] [--box X0,Y0,Z0,X1,Y1,Z1]

The copies lie side by side on the plane across the up axis, row by row in a square. Each has the Gaussians inside a
box, which by default holds most of the means. Copies differ slightly in positions, sizes, opacities and colours. The
output is a 3DGS PLY that is written piece by piece, so that memory is needed only for the model and a piece. Equal
arguments give equal bytes.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.camera import DEFAULT_NEAR_PLANE
from clsplat.errors import ClsplatError, InputError
from clsplat.files.atomic import atomic_writer, check_new
from clsplat.gaussians import MAX_SH_DEGREE, Gaussians
from clsplat.models.codec.ply_file import ALONG_RAYS_COMMENT, ANTIALIASED_COMMENT, NEAR_PLANE_COMMENT
from clsplat.models.edit import take
from clsplat.shots.viewpoints import extent_of

PIECE_ROWS = 1 << 16
"""Number of Gaussians that are written at once."""
SPREAD = 0.1
"""Standard deviation of a Gaussian's displacement in a copy, relative to its median scale, and of its logit."""
INSIDE = 0.8
"""Fraction of the means along each axis that the default box holds. The others may be far away, such as a sky's."""
SIZE_SPREAD, TINT_SPREAD = 0.03, 0.06
"""Standard deviations of the change of log scales, and of a copy's colour (`sh_dc`)."""

Box = tuple[NDArray[np.float64], NDArray[np.float64]]


def main(argv: Sequence[str] | None = None) -> int:
    """Write the model. Returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, help="a model of any format")
    parser.add_argument("output", type=Path, help="the PLY to write")
    parser.add_argument("--gaussians", type=int, required=True, help="number of Gaussians to write")
    parser.add_argument("--sh-degree", type=int, default=MAX_SH_DEGREE, help="largest degree of SH to keep; default 3")
    parser.add_argument("--up", choices=("x", "y", "z"), default="z", help="axis across the plane; default z")
    parser.add_argument("--box", help="corners of a tile, X0,Y0,Z0,X1,Y1,Z1; by default the box of most means")
    parser.add_argument("--seed", type=int, default=0, help="seed of the differences between copies; default 0")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")
    given = parser.parse_args(argv)
    try:
        check_new(given.output, overwrite=given.overwrite, sources=[given.model])
        if given.gaussians < 1 or not 0 <= given.sh_degree <= MAX_SH_DEGREE or given.seed < 0:
            raise InputError("expected --gaussians of at least 1, --sh-degree of 0 to 3 and a --seed of at least 0")
        copies = write_tiled(
            given.output,
            Gaussians.load(given.model),
            given.gaussians,
            sh_degree=given.sh_degree,
            up="xyz".index(given.up),
            box=None if given.box is None else corners(given.box),
            seed=given.seed,
        )
    except ClsplatError as error:
        print(f"tile_model: error: {error}", file=sys.stderr)
        return error.exit_status
    print(f"{given.output}: {given.gaussians:,} Gaussians in {copies:,} copies")
    return 0


def corners(text: str) -> Box:
    """Two corners, the low one first. Raises InputError for anything but six numbers in this order."""
    try:
        numbers = np.array([float(word) for word in text.split(",")]).reshape(2, 3)
    except ValueError:
        numbers = np.zeros((2, 3))
    if not (np.isfinite(numbers).all() and (numbers[0] < numbers[1]).all()):
        raise InputError(f"--box {text}: expected six numbers, the low corner first, such as 0,0,-2,120,120,25")
    return numbers[0], numbers[1]


def write_tiled(
    path: Path, model: Gaussians, count: int, *, sh_degree: int, up: int, box: Box | None, seed: int
) -> int:
    """Write `count` Gaussians. Returns the number of copies, the last of which may be incomplete.

    up: index of the axis across the plane.
    box: corners (3,) of a tile in world units, whose sides are also the distances between copies. None for the box of
        most means.
    Raises InputError if the box is empty.
    """
    low, high = extent_of(model.means, INSIDE) if box is None else (corner - model.origin for corner in box)
    inside = np.flatnonzero(((model.means >= low) & (model.means < high)).all(axis=1))
    if not len(inside):
        raise InputError(f"--box: has none of the {len(model):,} Gaussians, expected a part of the model")
    tile = take(model, inside)
    tile.sh = np.ascontiguousarray(tile.sh[:, : (sh_degree + 1) ** 2])
    copies = math.ceil(count / len(tile))
    across = [axis for axis in range(3) if axis != up]
    steps = np.zeros((2, 3))
    steps[[0, 1], across] = (high - low)[across]
    names = [*"xyz", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{index}" for index in range(3 * (tile.sh.shape[1] - 1))]
    names += ["opacity", *(f"scale_{axis}" for axis in range(3)), *(f"rot_{part}" for part in range(4))]
    header = _header(tile, count, names)
    with atomic_writer(path, len(header) + 4 * len(names) * count) as file:
        file.write(header)
        for block in _pieces(tile, count, steps, seed):
            file.write(block.data)
    return copies


def _header(tile: Gaussians, count: int, names: Sequence[str]) -> bytes:
    comments = [" ".join(ANTIALIASED_COMMENT)] if tile.antialiased else []
    comments += [" ".join(ALONG_RAYS_COMMENT)] if tile.by_rays else []
    comments += [" ".join([*NEAR_PLANE_COMMENT, repr(float(tile.near))])] if tile.near != DEFAULT_NEAR_PLANE else []
    lines = ["ply", "format binary_little_endian 1.0", *comments, f"element vertex {count}"]
    return "\n".join([*lines, *(f"property float {name}" for name in names), "end_header", ""]).encode("ascii")


def _pieces(tile: Gaussians, count: int, steps: NDArray[np.float64], seed: int) -> Iterator[Float32]:
    """Yield rows of the file, at most PIECE_ROWS at a time.

    steps: (2, 3), the displacement of the next copy in a row and in a column.
    """
    size = len(tile)
    side = math.ceil(math.sqrt(count / size))
    for copy in range(math.ceil(count / size)):
        tint = np.random.default_rng([seed, copy]).normal(0, TINT_SPREAD, 3)
        shift = copy % side * steps[0] + copy // side * steps[1]
        for first in range(0, min(size, count - copy * size), PIECE_ROWS):
            rows = slice(first, min(first + PIECE_ROWS, size, count - copy * size))
            generator = np.random.default_rng([seed, copy, first])
            yield _changed(tile, rows, shift, tint, generator)


def _changed(
    tile: Gaussians, rows: slice, shift: NDArray[np.float64], tint: NDArray[np.float64], generator: np.random.Generator
) -> Float32:
    """Rows (n, properties) of a copy, with its random changes."""
    log_scales, sh = tile.log_scales[rows], tile.sh[rows]
    number, rest = len(sh), 3 * (sh.shape[1] - 1)
    middle = np.exp(np.median(log_scales, axis=1, keepdims=True).astype(np.float64))
    block = np.zeros((number, 17 + rest), "<f4")
    block[:, 0:3] = tile.means[rows] + shift + SPREAD * middle * generator.normal(size=(number, 3))
    block[:, 6:9] = sh[:, 0] + tint + SPREAD * TINT_SPREAD * generator.normal(size=(number, 3))
    block[:, 9 : 9 + rest] = sh[:, 1:].transpose(0, 2, 1).reshape(number, rest)
    block[:, -8] = tile.opacity_logits[rows] + SPREAD * generator.normal(size=number)
    block[:, -7:-4] = log_scales + SIZE_SPREAD * generator.normal(size=(number, 3))
    block[:, -4:] = tile.quaternions[rows]
    return block


if __name__ == "__main__":
    sys.exit(main())
