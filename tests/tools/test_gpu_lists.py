# SPDX-License-Identifier: Apache-2.0
"""Lists by append in the model of a GPU's step: rounds of their loops, atomics, and the steps that are wanted."""

from __future__ import annotations

import json
import re
from collections import Counter
from dataclasses import asdict, fields

import gpu_page
import numpy as np
import pytest
from gpu_devices import GPUS
from gpu_frames import lists_in
from gpu_lists import AHEAD, OWN_BOX, SIDE, SMALL_BOX, Boxes, Sorting, boxes_of, lists_of, sorting_of
from gpu_measured import ATOMICS, CALIBRATION, DRAWN, Measured, fit_constants, read
from gpu_model import Constants, Work
from gpu_page import now_table, wanted_table
from gpu_rules import BY_ITEM
from gpu_run import Run
from gpu_shapes import on_each_gpu

from clsplat.device.source import kernel_root
from clsplat.stages.append import LOCAL_PAIRS

(H200,) = [each for each in GPUS if each.name == "H200"]


def walked(count: int, items: int) -> Sorting:
    """The loops of sort_lists (append.cl) for a list, counted while they run, for the first item of a group."""
    found: Counter[str] = Counter()

    def rounds(pairs: int) -> int:
        return len(range(0, pairs, items))

    stage = LOCAL_PAIRS // 2
    while stage == LOCAL_PAIRS // 2 or stage < count:
        found["stages"] += 1
        step = stage
        while step >= LOCAL_PAIRS:
            found["far_steps"] += 1
            found["ordered_far"] += rounds(-(-count // 2))
            step //= 2
        for first in range(0, count, LOCAL_PAIRS):
            here, sorts = min(LOCAL_PAIRS, count - first), stage < LOCAL_PAIRS
            found["parts"] += 1
            whole = LOCAL_PAIRS if not sorts else 1 << (here - 1).bit_length()
            found["fetched"] += -(-whole // (AHEAD * items))
            half = 1 if sorts else LOCAL_PAIRS // 2
            while half < (here if sorts else LOCAL_PAIRS):
                found["blocks"] += 1
                step = half
                while step:
                    found["steps"] += 1
                    apart = max(step // 2, 1)
                    found["ordered"] += rounds(sum(4 * k - 3 * (k % apart) < here for k in range(here)))
                    step //= 4
                half *= 2
            found["stored"] += rounds(here) if count > LOCAL_PAIRS else 0
        stage *= 2
    found["listed"] = -(-count // (AHEAD * items))
    return Sorting(**found)


@pytest.mark.parametrize("items", [32, 256])
@pytest.mark.parametrize("count", [0, 1, 2, 3, 64, 430, 2048, 2049, 3611, 4096, 5000, 16384])
def test_rounds_of_a_sort_are_those_of_its_loops(count: int, items: int) -> None:
    assert asdict(sorting_of([(1, count)], items)) == asdict(walked(count, items))


def test_a_sort_of_several_lists_is_their_mean() -> None:
    frame = lists_in(np.array([1, 3, 4, 4, 60]))
    assert frame == {
        "longest_listed": 60,
        "list_tiles": [1, 0, 3, 0, 0, 0, 1],
        "list_pairs": [1, 0, 11, 0, 0, 0, 60],
    }
    assert lists_of(frame) == [(1, 1), (3, 11 / 3), (1, 60)]
    found = sorting_of(lists_of(frame), 32)
    assert found.steps == (0 + 3 * 2 + 12) / 5
    assert found.listed == 1


def test_boxes_of_a_group() -> None:
    frame = {each.name: 1.0 for each in fields(Boxes)} | {"wide": 1 / 33, "wide_rows": 6.0}
    boxes = boxes_of(frame, 64)
    assert boxes.wide == pytest.approx(64 / 33)
    assert boxes.shared_rows(64) == boxes.wide, "all rows in one round"
    assert boxes.shared_rows(32) == pytest.approx(boxes.wide * 6 / 4)
    assert boxes.shared_columns == 1
    assert Boxes(wide_columns=20).shared_columns == 20 / 8


def test_rounds_over_tiles_are_those_of_the_frames_waves() -> None:
    """An item of `project` goes over rows that are tested alone; one of `duplicate`, over all in the order of depth."""
    boxes = Boxes(wave_rows=4, wave_tested=1, all_tested=1.5, all_pairs=14, sorted_rows=5, sorted_tested=2)
    run = Run(64, boxes=boxes)

    def rounds(kernel: str, text: str, part: bool = False) -> set[float]:
        return {rule.rounds(run) for rule in BY_ITEM[kernel] if rule.part is part and text in rule.text}

    assert rounds("project", "for (int ty") == {1.5, 4}, "the number of tiles, and of each tile's pairs"
    assert rounds("project_step", "addends") == {14}
    assert rounds("duplicate", "for (int ty") == {5}
    assert rounds("duplicate", "tangent", part=True) == {2 / 5}
    assert rounds("append_pairs", "for (int ty") == {4}
    for kernel in ("project", "append_pairs"):
        assert rounds(kernel, "tangent", part=True) == {1 / 4}


def test_sizes_are_the_kernels() -> None:
    text = (kernel_root() / "shared/list_counts.h").read_text()
    assert re.findall(r"^#define OWN_BOX (\d+)$", text, re.MULTILINE) == [str(OWN_BOX)]
    assert f"#define SMALL_BOX {SMALL_BOX}\n" in (kernel_root() / "shared/tile.h").read_text()
    assert f"#define SIDE (ITEMS < {SIDE} ? ITEMS : {SIDE})\n" in text


def test_atomics_take_what_an_h100_took() -> None:
    """The two constants are solved from two measurements; the model gives these back."""
    calibration = json.loads(CALIBRATION.read_text())
    constants = fit_constants(calibration, [])
    limits = next(row["limits"] for row in calibration if "limits" in row)
    for counters in ATOMICS:
        work = Work("append", 0, atomics=3.4e6, counters=counters)
        assert work.on(H200, constants).ms == pytest.approx(limits[f"3.4 M atomic_inc on {counters}, ms"])


def test_a_present_frame_is_that_of_its_own_launches() -> None:
    """A step has no radix sorts, and a frame no lists by append."""
    step, frame = (
        [Work(stage, 0, instructions=H200.issued * ms)] for stage, ms in (("append", 1.0), ("duplicate", 2.0))
    )
    then = asdict(Work("project", 0, instructions=H200.issued * 4))
    scene = {"scene": "s", "frame": "f", "frame_ms": 4.0, "step_ms": 5.0, "parts_ms": {}, "inputs": [then]}
    rows = [{"device": "NVIDIA H200", "gpu": "H200", "date": "today", "commit": "abc", "scenes": [scene]}]
    ((one,), _) = read(rows, {("H200", "f"): step, ("H200", "f" + DRAWN): frame})
    assert (one.now, one.drawn) == (step, frame)
    (told,) = [line for line in now_table([one], Constants(1.0, host=0)).splitlines() if line.startswith("| frame")]
    assert "4.000, 2.000, **0.50**" in told


def test_frames_of_few_tiles_have_larger_groups() -> None:
    """On the GPUs whose units would be idle, in the kernels whose groups follow the frame."""
    frames = [{"name": "small", "width": 16 * 1450, "height": 16}, {"name": "large", "width": 16 * 6700, "height": 16}]
    frames.append({"name": "middling", "width": 16 * 2500, "height": 16})
    kernels = ("blend", "sort_lists", "blend_grad", "adam")
    works = {
        f"1x{items}": {
            ("sm_90", name): [None, *(Work(kernel, items, kernel=kernel) for kernel in kernels)]
            for name in ("small", "small" + DRAWN, "middling", "large")
        }
        for items in (64, 128, 256)
    }
    found = on_each_gpu(works, frames)
    assert {gpu for gpu, _ in found} == {"H100 SXM", "H200"}
    assert [work and work.bytes for work in found["H200", "small"]] == [None, 256, 256, 64, 64]
    assert [work and work.bytes for work in found["H200", "middling"]] == [None, 128, 128, 64, 64]
    assert found["H200", "small" + DRAWN] == found["H200", "small"]
    assert found["H200", "large"] == works["1x64"]["sm_90", "large"]


def test_steps_that_are_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu_page, "WANTED_STEPS", (("H200", "f", 1.0), ("RTX 4090", "f", 0.1)))
    (ada,) = [each for each in GPUS if each.name == "RTX 4090"]
    then, now = ([Work("blend", 0, instructions=H200.issued * ms)] for ms in (2.0, 0.5))
    one = Measured(H200, "f", "", {"blend": 1.0, "step, wall": 4.0}, then, now)
    works = {("H200", "f"): now, ("RTX 4090", "f"): [Work("blend", 0, instructions=ada.issued * 0.5)]}
    *_, first, second = wanted_table([one], Constants(1.0, host=0), works).splitlines()
    assert first == "| H200, f | 2.00 | 0.50 | 1.0 | yes | -50%, 69% |"
    assert second == "| RTX 4090, f | not counted | 0.50 | 0.1 | no | not measured |"
