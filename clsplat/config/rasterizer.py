# SPDX-License-Identifier: Apache-2.0
"""Settings of the rasterizer: approximations that save time, and switches that benchmarks measure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from clsplat.config.checks import Rule, check_kinds, check_rules


@dataclass(frozen=True)
class RasterizerConfig:
    """Approximations of the rasterizer.

    Values other than the defaults change pictures, and save work; a lower alpha-min or transmittance-min costs work.

    sh-tolerance and sh-storage apply to frames of a model that stays on the device (render, eval), not to training.
    docs/performance.md has the error of each setting, and the time that it saves.
    """

    extent: Literal["opacity", "3sigma"] = "opacity"
    """Reach of a Gaussian. opacity: until its alpha falls to alpha-min. 3sigma: three standard deviations, which cuts
    off visible parts of opaque Gaussians (approximate)."""
    sh_degree_limit: int = 3
    """Leave out the bands of spherical harmonics (SH, colour by direction) above this degree, 0 to 3 (approximate)."""
    sh_tolerance: float = 0.0
    """Leave out a Gaussian's highest SH bands if no channel of its colour, 0 to 1, changes by more than this from any
    direction. 0 leaves out only bands that are zero (approximate above 0). Bands that no Gaussian needs are always left
    out. Bands that only some need are left out if that removes at least half of all coefficients; otherwise that would
    save no time."""
    sh_storage: Literal["float", "half"] = "float"
    """Store the SH bands above 0 in 32 or in 16 bits. half takes half of the memory, and is approximate."""
    alpha_min: float = 1 / 255
    """Skip a Gaussian at a pixel where its alpha is less than this. Values above the default, 1/255 or one step of 8
    bits, are approximate."""
    transmittance_min: float = 1e-4
    """Stop at a pixel before the Gaussian that would reduce its transmittance to this or less (approximate above
    1e-4)."""

    def check(self) -> None:
        """Raise InputError naming the first setting whose value is invalid."""
        rules: tuple[Rule, ...] = (
            (("sh_degree_limit",), lambda value: 0 <= value <= 3, "0 to 3"),
            (("sh_tolerance",), lambda value: 0 <= value <= 1, "0 to 1"),
            (("alpha_min",), lambda value: 1e-3 <= value < 0.5, "0.001 to 0.5"),
            (("transmittance_min",), lambda value: 1e-6 <= value < 0.5, "1e-6 to 0.5"),
        )
        check_kinds(self, "--rasterizer.")
        check_rules(self, "--rasterizer.", rules)

    def switches(self) -> BenchSwitches:
        """Return these settings as BenchSwitches, with the switches for measurements at their defaults."""
        return BenchSwitches(**vars(self))


@dataclass(frozen=True)
class BenchSwitches(RasterizerConfig):
    """Settings of the rasterizer, and further switches for measurements. The further switches change no bit of a frame.

    docs/performance.md has the error of each setting, and the time that it saves.
    """

    extent: Literal["opacity", "constant", "3sigma"] = "opacity"  # type: ignore[assignment]  # it allows one more value
    """Reach of a Gaussian. opacity: until its alpha falls to alpha-min. constant: as for an opaque Gaussian. 3sigma:
    three standard deviations, which cuts off visible parts of opaque Gaussians (approximate)."""
    tile_test: Literal["ellipse", "box", "square"] = "ellipse"
    """Tiles of 16 x 16 pixels that list a Gaussian. ellipse: the tiles that its ellipse reaches, or its whole bounding
    box if that has at most 16 tiles. box: its whole bounding box. square: the tiles within the square of its longest
    half axis, as in the code of Kerbl et al."""
    depth_sort: Literal["visible", "pairs"] = "visible"
    """Order of the sorts. visible: the visible Gaussians by depth, then their pairs with tiles, stably, by tile. pairs:
    all pairs by tile and depth, as in the code of Kerbl et al."""
    key_bits: Literal["needed", "all"] = "needed"
    """Bits of the sort keys. needed: only the bits in which the frame's depths and tiles differ. all: 32 of each."""
    row_skip: bool = True
    """Visit only the rows of a tile that a Gaussian's bounding box reaches."""
    column_skip: bool = True
    """Visit only the vectors (pixels that are processed at once) of a row that a Gaussian's bounding box reaches."""
    early_stop: bool = True
    """Leave a tile when all its pixels are opaque. If off, continue to its last Gaussian, which changes no pixel."""
    record_cells: bool = True
    """In a tile's gradient, visit only the cells of pixels to which a Gaussian contributes, as recorded by blending.
    If off, compute again which cells the Gaussian's ellipse reaches."""
    frustum_cull: bool = True
    """Leave out Gaussians that reach no tile of the image, before computing their colours. If off, they get a colour
    and a place in the depth order, without effect. Gaussians that are not in front of the near plane have no
    projection, and are always left out."""
