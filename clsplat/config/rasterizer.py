# SPDX-License-Identifier: Apache-2.0
"""Settings of the rasterizer, each default once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from clsplat.config.checks import Rule, check_kinds, check_rules


@dataclass(frozen=True)
class RasterizerConfig:
    """Approximations of the rasterizer: each saves work and changes pictures, but for the defaults.

    sh-tolerance and sh-storage are of frames of a model that is held on the device (render, eval), not of training.
    docs/performance.md has the error of each setting, and the time that it buys.
    """

    extent: Literal["opacity", "3sigma"] = "opacity"
    """Reach of a Gaussian. opacity: to where its alpha is alpha-min; 3sigma: three standard deviations, which cuts what
    is visible of opaque ones (approximate)."""
    sh_degree_limit: int = 3
    """Leave out the bands of spherical harmonics (SH, colour by direction) above this degree, 0 to 3 (approximate)."""
    sh_tolerance: float = 0.0
    """Leave out a Gaussian's highest SH bands as long as that changes no channel of its colour, 0 to 1, by more than
    this, from any direction: 0 leaves out those that are zero (approximate above 0). Bands that none needs are always
    left out, those that some need only where that is half of all coefficients: from there on it pays."""
    sh_storage: Literal["float", "half"] = "float"
    """Keep the SH bands above 0 in 32 or in 16 bits (half is approximate, of half the memory)."""
    alpha_min: float = 1 / 255
    """Skip a Gaussian at a pixel where its alpha is less than this (approximate above the default, 1/255: one step of 8
    bits)."""
    transmittance_min: float = 1e-4
    """A Gaussian that would take a pixel's transmittance to this or less is left out and ends the pixel (approximate
    above 1e-4)."""

    def check(self) -> None:
        """Raise InputError naming the first setting whose value makes no sense."""
        rules: tuple[Rule, ...] = (
            (("sh_degree_limit",), lambda value: 0 <= value <= 3, "0 to 3"),
            (("sh_tolerance",), lambda value: 0 <= value <= 1, "0 to 1"),
            (("alpha_min",), lambda value: 1e-3 <= value < 0.5, "0.001 to 0.5"),
            (("transmittance_min",), lambda value: 1e-6 <= value < 0.5, "1e-6 to 0.5"),
        )
        check_kinds(self, "--rasterizer.")
        check_rules(self, "--rasterizer.", rules)

    def switches(self) -> BenchSwitches:
        """Every setting that the rasterizer reads. Switches that this configuration does not have are on."""
        return BenchSwitches(**vars(self))


@dataclass(frozen=True)
class BenchSwitches(RasterizerConfig):
    """Settings of the rasterizer, with the switches that change no bit of a frame and are there to be measured.

    docs/performance.md has the error of each setting, and the time that it buys.
    """

    extent: Literal["opacity", "constant", "3sigma"] = "opacity"  # type: ignore[assignment]  # one value more
    """Reach of a Gaussian. opacity: to where its alpha is alpha-min; constant: as far as an opaque one would, whatever
    its opacity; 3sigma: three standard deviations, which cuts what is visible of opaque ones (approximate)."""
    tile_test: Literal["ellipse", "box", "square"] = "ellipse"
    """Tiles of 16 x 16 pixels that a Gaussian is listed in. ellipse: those that its ellipse reaches, or all of its
    bounding box where that has at most 16; box: all of its bounding box; square: those that the square of its longest
    half axis reaches, as in the code of Kerbl et al."""
    depth_sort: Literal["visible", "pairs"] = "visible"
    """Order of the sorts. visible: the visible Gaussians by depth, then their pairs with tiles, stably, by tile; pairs:
    all pairs by tile and depth, as in the code of Kerbl et al."""
    key_bits: Literal["needed", "all"] = "needed"
    """Bits that are sorted by. needed: those in which the depths of the frame and its tiles differ; all: 32 of each."""
    row_skip: bool = True
    """Visit only the rows of a tile that a Gaussian's bounding box reaches."""
    column_skip: bool = True
    """Visit only the vectors (pixels that are worked on at once) of a row that a Gaussian's bounding box reaches."""
    vector_skip: bool = True
    """Leave a vector of pixels when the Gaussian contributes to none of them. Frames on a CPU have no use for it: their
    vectors are found by the ellipse, so that few are visited in vain."""
    early_stop: bool = True
    """Leave a tile when all its pixels are opaque; else go on to its last Gaussian, to no effect."""
    last_contributor: bool = True
    """A tile's gradient begins at the last Gaussian that one of its pixels takes, or at its last, to no effect."""
    record_cells: bool = True
    """A tile's gradient visits the cells of pixels in which a Gaussian contributes, as blending has recorded them; else
    it finds those that the ellipse reaches once more."""
    gradient_skip: bool = True
    """A tile's gradient leaves out the recorded cells in which no pixel has one."""
    frustum_cull: bool = True
    """Leave out a Gaussian that reaches no tile of the image before its colour is worked out; else it has a colour and
    a place in the order of depth, to no effect. What is not in front of the near plane has no projection, and is always
    left out."""
    opacity_cull: bool = True
    """Leave out a Gaussian whose opacity is not over alpha-min before its colour is worked out; else as with
    frustum-cull off, wherever it lies: it has no extent."""
