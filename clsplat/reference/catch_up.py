# SPDX-License-Identifier: Apache-2.0
"""Catching up on the steps of Adam that chunks of a model missed: float64 twin of kernels/catch_up.cl."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from clsplat.arrays import Float64
from clsplat.reference.adam import missed_steps

State = tuple[Float64, Float64, Float64]
"""Values of a parameter group, and their first and second moments in Adam. The arrays have the same shape."""


def catch_up(
    groups: Mapping[str, State],
    chunk_rows: int,
    last_by_chunk: Mapping[int, int],
    rates: Mapping[int, Mapping[str, float]],
    sh_rest_every: int,
) -> dict[str, State]:
    """Return the parameter groups after chunks have taken the Adam steps that they missed, with zero gradients.

    The step is eq. (42) of docs/gradients.md.

    groups: by parameter group, its values and moments (n, ...).
    chunk_rows: number of rows of a chunk.
    last_by_chunk: by chunk, the number of the last step that it has taken. Other chunks are not changed.
    rates: learning rates by number of the step, then by group. The largest number is the last step to take.
    sh_rest_every: the group `sh_rest` takes only steps whose number is a multiple of this.
    """
    caught: dict[str, State] = {}
    for group, before in groups.items():
        every = sh_rest_every if group == "sh_rest" else 1
        after = tuple(values.copy() for values in before)
        for chunk, last in last_by_chunk.items():
            rows = slice(chunk * chunk_rows, (chunk + 1) * chunk_rows)
            due: Sequence[float] = [
                rates[number][group] for number in sorted(rates) if number > last and number % every == 0
            ]
            p, m, v = (values[rows] for values in before)
            for values, found in zip(after, missed_steps(p, m, v, last // every, due), strict=True):
                values[rows] = found
        caught[group] = (after[0], after[1], after[2])
    return caught
