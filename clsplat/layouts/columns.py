# SPDX-License-Identifier: Apache-2.0
"""Array layouts (columns by name) and constants that Python and the kernels share.

Kernels include them as `kernels/shared/layouts.h`.

`python -m clsplat.layouts.columns > kernels/shared/layouts.h` generates that file.
"""

from __future__ import annotations

from typing import NamedTuple

from clsplat.config.pictures import HOLDOUT_SURFACE_FIELDS
from clsplat.optimisation.density_rules import FRESH, FROZEN, UNWANTED, USELESS

TILE = 16  # tile_size in gsplat
"""Tile size: side of a tile in pixels (Kerbl et al. 2023, section 6)."""

GRID_SHAPE = (8, 16, 16, 3, 4)
"""Size of a bilateral grid: levels, rows and columns, then the shape of the colour transform at each vertex
(`kernels/grid.cl`)."""

LOSS_ROWS, LOSS_COLUMNS, LOSS_GROUP_ROWS, LOSS_GROUP_COLUMNS = 2, 640, 7, 54
"""Sizes of the blocks of pixels that work-groups of the loss kernel process (`kernels/loss.cl`).

LOSS_ROWS: number of rows that a work-group of one work-item processes together, as their windows share pixels.
LOSS_COLUMNS: maximum number of columns in a block of a work-group of one work-item.
LOSS_GROUP_ROWS, LOSS_GROUP_COLUMNS: rows and columns of a block for a work-group of several work-items.

Five arrays with a value for each pixel of a block must fit in 32 KiB of local memory. Several work-items share the work
on a block in LOSS_PARTS parts. For vertical windows, the parts are the 64 columns of the block and its margins. For
horizontal windows, they are 63 runs of six pixels. So nearly every part has work in both directions.
"""

LOSS_PARTS = 64
"""Number of parts into which a work-group of several work-items divides a block of the loss, and the maximum number of
these work-items. It is LOSS_GROUP_COLUMNS plus margins of five columns on each side."""

LOSS_RING = 16
"""Number of rows of SSIM's partial derivatives that a work-group of one work-item stores at a time.

It is a power of two and a multiple of LOSS_ROWS, and at least the window's 11 rows plus LOSS_ROWS - 1.
"""

CHUNK_ROWS = 1024
"""Chunk size: number of consecutive rows of a model in a chunk. The last chunk may have fewer rows, and in a streamed
model any chunk."""

POSE_ROWS = 64
"""Number of Gaussians whose terms of a pose gradient one work-item adds in sequence, to a partial sum."""

_TRANSFORM = (
    *(f"R{row}{column}" for row in range(3) for column in range(3)),
    *("T0", "T1", "T2"),
    *("FX", "FY", "CX", "CY"),
)

_ROUNDED = (*_TRANSFORM, *("XMIN", "XMAX", "YMIN", "YMAX"), *("PX", "PY", "PZ"))

_LENS = ("K1", "K2", "K3", "K4", "FOLD", "FOLD_RADIUS")

CAMERA = (*_ROUNDED, "NEAR", "FAR", "HAND", "WINDOW_X", "WINDOW_Y", *_LENS, *(f"{name}_LOW" for name in _ROUNDED))
"""The fields of a camera for the projection kernels, in order.

- `cam_from_world`, intrinsics, the limits of x/z and y/z in the Jacobian, and the camera's centre.
- Near and far plane.
- HAND: 1, or -1 if the rotation is a reflection.
- The position in the whole frame of the image's first pixel (`Camera.window`).
- A fisheye's coefficients, and the largest angle and distance from the axis that the lens shows.
- _LOW: the rounding errors in float32 of the first item of this list. With them, a mean on the image is accurate to
  1e-6 pixels, and the ellipse of a needle to 1e-4.
"""

_EWA_ROUNDED = (
    *_TRANSFORM,
    *("XMIN", "XMAX", "YMIN", "YMAX"),
    *(f"N{row}{column}" for row in range(3) for column in range(3)),
)

EWA_CAMERA = (
    *_EWA_ROUNDED,
    *("NEAR", "FAR", "WIDTH", "HEIGHT", "EPS", "RADIUS_CLIP"),
    *(f"{name}_LOW" for name in _EWA_ROUNDED),
)
"""The fields of a camera for `kernels/ewa.cl`, in order.

- The view matrix, which need not be a rotation; intrinsics; the limits of x/z and y/z in the Jacobian; the cofactors
  of the matrix's 3 x 3 part.
- Near and far plane, the image's size, the low-pass in px^2, and the radius up to which Gaussians are culled.
- _LOW: the rounding errors in float32 of the first item of this list.
"""

EWA_GRADIENT = _TRANSFORM
"""The fields of a camera with respect to which `kernels/ewa_grad.cl` computes gradients."""

SUM_ROWS = 64
"""Number of adjacent values of a row that one work-item of `kernels/sums.cl` adds."""

NO_CHUNK = 0x3FFFFF
"""Number in a list of chunks that means "no chunk". A chunk of this number would be past the end of every model."""

_SEEN = ("LOG2O", "RED", "GREEN", "BLUE", "DEPTH")
"""Fields that have the same meaning and position in SPLAT and RAY, so that blending can read both."""

SPLAT = (
    *("PIXEL_X", "PIXEL_Y", "SUB_X", "SUB_Y", "L11", "L12", "L22"),
    *_SEEN,
    *("HALF_W", "HALF_H", "INVERSE_L11", "UNUSED"),
)
"""The fields of a splat, a projected Gaussian, in order. They take 64 bytes, a cache line.

- The mean in whole pixels, and the fraction of a pixel.
- L11 to L22: the whitening W of docs/gradients.md times sqrt(log2(e) / 2), so that log2(alpha) = LOG2O - u^2 - v^2.
- Log of the opacity, colour, camera depth.
- Half extents in pixels of the ellipse where alpha is 1/255.
"""

RAY = (
    *("FX", "FY", "FZ", "UX", "UY", "UZ", "VX"),
    *_SEEN,
    *("VY", "VZ", "COLUMNS", "ROWS"),
)
assert len(RAY) == len(SPLAT), "rows of RAY and of SPLAT are stored in the same array"
assert all(RAY.index(name) == SPLAT.index(name) for name in _SEEN), "blending reads these fields of RAY and SPLAT"
"""A projected Gaussian of a camera model along rays, such as equirectangular or fisheye.

F: direction of the mean.
U, V: a ray r in the camera has u = U.r / F.r and v = V.r / F.r, so that log2(alpha) = LOG2O - u^2 - v^2.
DEPTH: the distance of the mean from the camera's centre.
COLUMNS, ROWS: the bounding box in tiles: 16 bits for the first tile, 16 for the end (kernels/shared/tile.h).
"""

SLOT = ("G", "GU", "GV", "GUU", "GUV", "GVV", "RED", "GREEN", "BLUE", "ABSX", "ABSY")
"""Partial gradients of a (tile, Gaussian) pair. ABSX and ABSY exist only if absolute gradients (absgrad) are computed.

If contributions are computed, the sum of blending weights follows. If the loss compares depths, the gradient with
respect to nearness, 1 / depth, is last (`kernels/shared/splat.h`: SLOT_WEIGHT, SLOT_NEAR).
"""

SLOT_PLAIN = SLOT.index("ABSX")

REFUSED = ("parameters", "gradients", "moments", "steps")
"""Reasons for which adam.cl refuses to update an element: the parameter, its gradient, its moments or the step are not
finite or too large. adam.cl counts the refused elements by reason."""

COUNTED = ("VISIBLE", "PAIRS", "KEY_COMPLEMENT", "LARGEST_KEY", "LONGEST")

READBACK = (*COUNTED, "STOPPED", *(f"REFUSED_{reason.upper()}" for reason in REFUSED))
"""Numbers that the host reads back from a forward pass, in a single copy.

VISIBLE, PAIRS: numbers of visible Gaussians and of pairs.
KEY_COMPLEMENT, LARGEST_KEY: the complement of the smallest depth key, and the largest depth key.
LONGEST: the length of the longest list, in a pass whose lists are made by append (append.cl); otherwise 0.
STOPPED: 1 after a pass by capacity has stopped (duplicate.cl, append.cl).
REFUSED_*: numbers of elements that `adam` did not update, by reason.
"""


DEEP_SLICE = ("RED", "GREEN", "BLUE", "ALPHA", "DEPTH")
"""A slice of a deep picture at a pixel: premultiplied colour, alpha, and depth."""

DEEP_LEVELS = 64
"""Number of values of the slack s, equation (74) of docs/pictures.md, that are tried to cut a pixel into slices."""

DEEP_PICTURES = 16
"""Maximum number of deep pictures that are merged at once."""


class SlotFields(NamedTuple):
    """Fields of a slot in addition to the plain gradients.

    absolute: absolute gradients (AbsGS, `absgrad` in gsplat), in the columns ABSX and ABSY.
    contributions: the sum of blending weights.
    nearness: the gradient with respect to nearness, 1 / depth.
    """

    absolute: bool = False
    contributions: bool = False
    nearness: bool = False

    @property
    def floats(self) -> int:
        """Number of floats per slot."""
        return (len(SLOT) if self.absolute else SLOT_PLAIN) + self.contributions + self.nearness

    @property
    def defines(self) -> dict[str, object]:
        """Preprocessor defines of kernels that write or read slots with these fields; empty for plain gradients."""
        wanted = {
            "ABSOLUTE_GRADIENTS": self.absolute,
            "CONTRIBUTIONS": self.contributions,
            "NEARNESS": self.nearness,
        }
        return {name: True for name, on in wanted.items() if on}


PLAIN_SLOTS = SlotFields()
WIDEST_SLOTS = SlotFields(absolute=True, contributions=True, nearness=True)


def header() -> str:
    """The text of `kernels/shared/layouts.h`."""
    lines = ["// Layouts and constants that kernels share with Python: made by `python -m clsplat.layouts.columns`."]
    lines += [f"#define TILE {TILE}", f"#define LOSS_RING {LOSS_RING}", f"#define DEEP_LEVELS {DEEP_LEVELS}"]
    lines.append(f"#define DEEP_PICTURES {DEEP_PICTURES}")
    lines += [f"#define LOSS_ROWS {LOSS_ROWS}", f"#define LOSS_COLUMNS {LOSS_COLUMNS}"]
    lines += [f"#define LOSS_GROUP_ROWS {LOSS_GROUP_ROWS}", f"#define LOSS_GROUP_COLUMNS {LOSS_GROUP_COLUMNS}"]
    lines.append(f"#define LOSS_PARTS {LOSS_PARTS}")
    lines += [f"#define POSE_ROWS {POSE_ROWS}u", f"#define SUM_ROWS {SUM_ROWS}u"]
    lines.append(f"#define CHUNK_ROWS {CHUNK_ROWS}u")
    lines += [f"#define FRESH {FRESH:#x}u", f"#define UNWANTED {UNWANTED}f", f"#define USELESS {USELESS}f"]
    lines.append(f"#define FROZEN {FROZEN}f")
    layouts = {"CAMERA": CAMERA, "SPLAT": SPLAT, "RAY": RAY, "SLOT": SLOT, "READBACK": READBACK}
    layouts |= {"DEEP": DEEP_SLICE, "HELD": HOLDOUT_SURFACE_FIELDS, "EWA": EWA_CAMERA, "BY_CAMERA": EWA_GRADIENT}
    for prefix, fields in layouts.items():
        lines += [f"#define {prefix}_{name} {offset}" for offset, name in enumerate(fields)]
        lines.append(f"#define {prefix}_SIZE {len(fields)}")
    lines.append(f"#define SLOT_PLAIN {SLOT_PLAIN}")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(header(), end="")
