# SPDX-License-Identifier: Apache-2.0
"""The table of colour models: appearance models that remove a photograph's own colours pixel by pixel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

GAIN_ENTRIES = 3
"""Number of gains of a photograph, its first entries."""


@dataclass(frozen=True)
class ColourModel:
    """An appearance model that removes a photograph's own colours pixel by pixel.

    kernels/STEM.cl has its formulas, and clsplat/reference/STEM.py is their twin.

    of_photograph: the number of a photograph's entries by their name in appearance.json. The first three are base-2
    logarithms of gains; the others are coefficients from -0.2 to 0.2.
    of_lens: the same for a lens; three base-2 logarithms, or none.
    """

    stem: str
    of_photograph: Mapping[str, int]
    of_lens: Mapping[str, int] = field(default_factory=dict)

    @property
    def entries(self) -> int:
        """Number of entries of a photograph."""
        return sum(self.of_photograph.values())

    @property
    def lens_entries(self) -> int:
        """Number of entries of a lens; 0 if nothing is learnt of lenses."""
        return sum(self.of_lens.values())

    @property
    def sums(self) -> int:
        """Number of sums of the gradient."""
        return self.entries + self.lens_entries

    @property
    def pixel_bytes(self) -> int:
        """Bytes of the partial sums per pixel, padding included."""
        return -(-2 * self.sums // 3)


COLOUR_MODELS = {
    model.stem: model
    for model in (
        ColourModel("exposure", {"log2_gains": GAIN_ENTRIES}),
        ColourModel("ppisp", {"log2_gains": GAIN_ENTRIES, "mixes": 6}, {"vignette": 3}),
    )
}
"""Colour models by value of the setting `appearance`. The self-test has a stage for each."""
