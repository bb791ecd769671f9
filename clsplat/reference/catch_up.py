# SPDX-License-Identifier: Apache-2.0
"""Missed steps of chunks of a model: float64 twin of kernels/catch_up.cl."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from clsplat.arrays import Float64
from clsplat.reference.adam import missed_steps

State = tuple[Float64, Float64, Float64]
"""Parameters of a group and both moments."""


def catch_up(
    groups: Mapping[str, State],
    chunk_rows: int,
    last_by_chunk: Mapping[int, int],
    rates: Mapping[int, Mapping[str, float]],
    sh_rest_every: int,
) -> dict[str, State]:
    """Eq. (42) without a gradient: the groups after the steps that these chunks missed.

    groups: arrays (n, ...) of each parameter group.
    last_by_chunk: the last step that each chunk of `chunk_rows` rows has taken.
    rates: the learning rates of the groups, by number of the step. Its largest number is the last step that is taken.
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
