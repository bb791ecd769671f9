# SPDX-License-Identifier: Apache-2.0
"""Passes through the banks of local memory, in the model of a GPU's step."""

from __future__ import annotations

import numpy as np
import pytest
from gpu_assembly import Block, Instruction
from gpu_banks import BANKS, ROW, RUN, RUNS, SCATTERED, passes
from gpu_chain import Chain, chain_of

from clsplat.device.source import kernel_root
from clsplat.layouts.columns import LOSS_GROUP_COLUMNS, LOSS_PARTS


@pytest.mark.parametrize(
    ("name", "text", "wave", "wanted"),
    [
        ("LDS", "scratch[item - step]", 32, (1, 0)),
        ("LDS", "scratch[item - step]", 64, (2, 0)),  # of 64 items, 32 pass at a time
        ("STS.128", "*(__local floatA *)(by_sh_rest + k) = ahead[i];", 32, (4, 0)),
        ("ds_read_b128", "g = *(__local const floatA *)(step.gradients + k);", 32, (4, 0)),
        ("LDS.128", "const Staged s = staged[j];", 32, (1, 0)),  # all read the same splat
        ("LDS", "slot[i] = count > fit ? list[place].x : near[PLACE(place)].x;", 32, (2, 1)),  # every other word
        ("LDS.64", "const float v = in[i + FIELD], c = in[i + 2 * FIELD];", 32, (4, 2)),
        ("STS", "*counter += 1u << lift;", 32, (SCATTERED, SCATTERED - 1)),
        ("ATOMS.MAX.S32", "ALL_CELLS(cell) atomic_max(lasts + OWN_BLOCK(cell), pixels.stop[cell]);", 32, (32, 31)),
        ("ATOMS.POPC.INC.32", "atomic_inc(open_in + OWN_BLOCK(cell));", 32, (1, 0)),  # items are counted before
        ("LDL", "colour = sh_fma(basis[k].lane[lane]", 32, (0, 0)),
    ],
)
def test_passes_of_an_access(name: str, text: str, wave: int, wanted: tuple[float, float]) -> None:
    assert passes(Instruction(name, "shared"), text, wave) == pytest.approx(wanted)
    assert passes(Instruction(name, "global"), text, wave) == (0, 0)


def test_random_words_conflict_as_said() -> None:
    words = np.random.default_rng(0).integers(0, BANKS, (20_000, 32))
    fullest = (words[:, :, None] == np.arange(BANKS)).sum(1).max(1)
    assert fullest.mean() == pytest.approx(SCATTERED, abs=0.03), "0.005 standard error of the mean, and two digits"


def test_conflicts_delay_a_result_and_passes_are_counted() -> None:
    load, use = (
        Instruction("LDS", "shared", control=1 | 0 << 5 | 7 << 8),
        Instruction("FADD", "fp32", control=4 | 7 << 5 | 7 << 8 | 1 << 11),
    )
    found = chain_of(
        [(Block(body=[load, use]), 0.5)], lambda _: 0, passes_of=lambda each: (3, 2) if each is load else (0, 0)
    )
    assert found == Chain(cycles=(30 + 2 + 4) / 2, passes=3 / 2)


def test_sizes_are_the_kernels() -> None:
    assert f"#define RUN {RUN}\n" in (kernel_root() / "shared/loss_groups.h").read_text()
    assert RUNS == LOSS_GROUP_COLUMNS // RUN
    assert ROW == LOSS_PARTS
