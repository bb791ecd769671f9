# SPDX-License-Identifier: Apache-2.0
"""Table of colour models (exposure, ppisp): appearance models that remove a photograph's own exposure, white balance
and vignette pixel by pixel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

FULL_LENGTH_STEPS = 10_000
"""Number of steps below which a training counts as short. In a training of this length, at the learning rate of the
settings, a gain can change by about 2 octaves."""
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


def rise_in_short_training(steps: int) -> float:
    """Factor on the learning rate of colour models in a training of `steps` steps, so that gains can change by as much
    as in a long one."""
    return max(FULL_LENGTH_STEPS / steps, 1.0)


def appearance_rate_of_part(rate: float, kind: str, whole: int, part: int) -> float:
    """Return the setting `appearance_rate` of a training of `part` steps, for steps as large as in a training of
    `whole` steps with `rate`. Otherwise gains would move as far in few steps, and would be random.

    kind: the setting `appearance`.
    """
    if kind not in COLOUR_MODELS:  # only colour models have higher rates in short trainings
        return rate
    return rate * rise_in_short_training(whole) / rise_in_short_training(part)
