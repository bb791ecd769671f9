# SPDX-License-Identifier: Apache-2.0
"""Table of colour models (exposure, ppisp): appearance models that remove a photograph's own exposure, white balance
and vignette pixel by pixel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

GAIN_ENTRIES = 3
"""Number of gains of a photograph, one for each colour channel. They are the first values learnt for a photograph."""


@dataclass(frozen=True)
class ColourModel:
    """An appearance model that removes a photograph's own colours pixel by pixel.

    stem: value of the setting `appearance`, and name of the formulas: kernels/STEM.cl and clsplat/reference/STEM.py.
    of_photograph: number of values learnt for each photograph, by their name in appearance.json. The first three are
    base-2 logarithms of gains; the others are coefficients from -0.2 to 0.2.
    of_lens: number of values learnt for each lens, by their name: three base-2 logarithms, or none.
    """

    stem: str
    of_photograph: Mapping[str, int]
    of_lens: Mapping[str, int] = field(default_factory=dict)

    @property
    def entries(self) -> int:
        """Number of values learnt for each photograph."""
        return sum(self.of_photograph.values())

    @property
    def lens_entries(self) -> int:
        """Number of values learnt for each lens; 0 if the model learns nothing for lenses."""
        return sum(self.of_lens.values())

    @property
    def sums(self) -> int:
        """Number of sums over pixels in the gradient: one for each value learnt for the photograph or its lens."""
        return self.entries + self.lens_entries

    @property
    def pixel_bytes(self) -> int:
        """Memory of the gradient's partial sums in bytes per pixel of a photograph, padding included."""
        return -(-2 * self.sums // 3)


COLOUR_MODELS = {
    model.stem: model
    for model in (
        ColourModel("exposure", {"log2_gains": GAIN_ENTRIES}),
        ColourModel("ppisp", {"log2_gains": GAIN_ENTRIES, "mixes": 6}, {"vignette": 3}),
    )
}
"""Colour models by value of the setting `appearance`. Each is a stage of the self-test."""
