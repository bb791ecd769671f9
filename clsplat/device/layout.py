# SPDX-License-Identifier: Apache-2.0
"""The layouts that host and kernels share, declared once: the kernels get them as `#define`s on top of their text."""

from __future__ import annotations

from dataclasses import dataclass

from clsplat.config.holdout import HELD
from clsplat.config.marking import FRESH, UNWANTED, USELESS

TILE = 16
"""Side of a tile in pixels (Kerbl et al. 2023, section 6)."""

LOSS_ROWS, LOSS_COLUMNS, LOSS_GROUP_COLUMNS = 2, 640, 32
"""Rows of a block of the loss that a group of one item has under way, as their windows share pixels; most columns of
a block where a group is one item and where it has several: local memory holds five of these rows, or of as many as
sixteen, in 32 KiB."""

LOSS_RING = 16
"""Rows of derivatives that a group of one item keeps: a power of two, at least the window's 11 and all but one of
LOSS_ROWS, up to a multiple of LOSS_ROWS."""

POSE_ROWS = 64
"""Gaussians whose part in the gradient by a camera's pose is added up one behind the other."""

_TRANSFORM = (
    *(f"R{row}{column}" for row in range(3) for column in range(3)),
    *("T0", "T1", "T2"),
    *("FX", "FY", "CX", "CY"),
)

_ROUNDED = (*_TRANSFORM, *("XMIN", "XMAX", "YMIN", "YMAX"), *("PX", "PY", "PZ"))

_LENS = ("K1", "K2", "K3", "K4", "FOLD", "FOLD_RADIUS")

CAMERA = (*_ROUNDED, "NEAR", "FAR", "HAND", "WINDOW_X", "WINDOW_Y", *_LENS, *(f"{name}_LOW" for name in _ROUNDED))
"""A camera: `cam_from_world`, intrinsics, the limits of x/z and y/z in the Jacobian, its centre; near and far plane;
1, or -1 where its rotation is a reflection; the first pixel in its frame (`Camera.window`); a fisheye's
coefficients, and the angle and the distance from the axis that it shows; and what the rounding of them to
float32 left, so that a mean's place on the image is good to 1e-6 pixels, and a needle's ellipse to 1e-4."""

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
"""A camera of `kernels/ewa.cl`: the view matrix, which may be any, intrinsics, the limits of x/z and y/z in the
Jacobian, the cofactors of the matrix' 3 x 3 numbers; planes, the image's size, the low-pass in px^2 and the radius that
is too small; and what the rounding to float32 left."""

EWA_GRADIENT = _TRANSFORM
"""Numbers of a camera that `kernels/ewa_grad.cl` has gradients by."""

SUM_ROWS = 64
"""Neighbouring numbers that an item of `kernels/sums.cl` adds up."""

_SEEN = ("LOG2O", "RED", "GREEN", "BLUE", "DEPTH")
"""The part of SPLAT and of RAY that is one thing at one place: blending reads it whichever it has."""

SPLAT = (
    *("PIXEL_X", "PIXEL_Y", "SUB_X", "SUB_Y", "L11", "L12", "L22"),
    *_SEEN,
    *("HALF_W", "HALF_H", "INVERSE_L11", "UNUSED"),
)
"""A projected Gaussian in 64 bytes, a cache line: mean in whole pixels and the rest; the whitening W of
docs/gradients.md times sqrt(log2(e) / 2), so that log2(alpha) = LOG2O - u^2 - v^2; colour; camera depth; half extents
in pixels of the ellipse where alpha is 1/255."""

RAY = (
    *("FX", "FY", "FZ", "UX", "UY", "UZ", "VX"),
    *_SEEN,
    *("VY", "VZ", "COLUMNS", "ROWS"),
)
assert len(RAY) == len(SPLAT), "they share the array"
assert all(RAY.index(name) == SPLAT.index(name) for name in _SEEN), "blending reads either"
"""The same of an equirectangular or fisheye camera: the mean's direction F; U
and V, of which a ray r in the camera makes u = U.r / F.r and v = V.r / F.r, so that log2(alpha) = LOG2O - u^2 - v^2;
distance; tiles of the box, 16 bits each, first and one past the last (kernels/shared/tile.h)."""

SLOT = ("G", "GU", "GV", "GUU", "GUV", "GVV", "RED", "GREEN", "BLUE", "ABSX", "ABSY")
"""Partial gradients of one (tile, Gaussian) pair; the last two only where absolute gradients are kept. Where
contributions are kept, the sum of the blending weights is behind them all, and behind that, where depths are compared,
the gradient by nearness (`kernels/shared/splat.h`: SLOT_WEIGHT, SLOT_NEAR)."""

SLOT_PLAIN = SLOT.index("ABSX")

REFUSED = ("parameters", "gradients", "moments", "steps")
"""Reasons that adam.cl counts for refused steps of elements."""

COUNTED = ("VISIBLE", "PAIRS", "KEY_COMPLEMENT", "LARGEST_KEY")

READBACK = (*COUNTED, "STOPPED", *(f"REFUSED_{reason.upper()}" for reason in REFUSED))
"""Numbers that a forward pass reads back, in one copy: of its own the totals of visible Gaussians and of pairs, the
complement of the smallest depth key and the largest one; 1 from where a pass by capacity has stopped (duplicate.cl);
and what `adam` has counted since."""


DEEP = ("RED", "GREEN", "BLUE", "ALPHA", "DEPTH")
"""A pixel's slice of a deep picture: colour, associated with alpha; alpha; the depth at which it is."""

DEEP_LEVELS = 64
"""Steps of the slack that a pixel's slices are cut with."""


@dataclass(frozen=True)
class SlotFields:
    """Fields of a slot beside the plain gradients: absolute ones (AbsGS), the contribution to the image, the gradient
    by nearness (one over the depth)."""

    absolute: bool = False
    contributions: bool = False
    nearness: bool = False

    @property
    def floats(self) -> int:
        """Floats from one slot to the next."""
        return (len(SLOT) if self.absolute else SLOT_PLAIN) + self.contributions + self.nearness

    @property
    def defines(self) -> dict[str, object]:
        """Defines for the kernels that write and read slots; none for the plain ones."""
        wanted = {
            "ABSOLUTE_GRADIENTS": self.absolute,
            "CONTRIBUTIONS": self.contributions,
            "NEARNESS": self.nearness,
        }
        return {name: True for name, on in wanted.items() if on}


PLAIN_SLOTS = SlotFields()
WIDEST_SLOTS = SlotFields(absolute=True, contributions=True, nearness=True)


def header() -> str:
    """The declarations as OpenCL C."""
    lines = [f"#define TILE {TILE}", f"#define LOSS_RING {LOSS_RING}", f"#define DEEP_LEVELS {DEEP_LEVELS}"]
    lines += [f"#define LOSS_ROWS {LOSS_ROWS}", f"#define LOSS_COLUMNS {LOSS_COLUMNS}"]
    lines.append(f"#define LOSS_GROUP_COLUMNS {LOSS_GROUP_COLUMNS}")
    lines += [f"#define POSE_ROWS {POSE_ROWS}u", f"#define SUM_ROWS {SUM_ROWS}u"]
    lines += [f"#define FRESH {FRESH:#x}u", f"#define UNWANTED {UNWANTED}f", f"#define USELESS {USELESS}f"]
    layouts = {"CAMERA": CAMERA, "SPLAT": SPLAT, "RAY": RAY, "SLOT": SLOT, "READBACK": READBACK}
    layouts |= {"DEEP": DEEP, "HELD": HELD, "EWA": EWA_CAMERA, "BY_CAMERA": EWA_GRADIENT}
    for prefix, fields in layouts.items():
        lines += [f"#define {prefix}_{name} {offset}" for offset, name in enumerate(fields)]
        lines.append(f"#define {prefix}_SIZE {len(fields)}")
    lines.append(f"#define SLOT_PLAIN {SLOT_PLAIN}")
    return "\n".join(lines) + "\n"
