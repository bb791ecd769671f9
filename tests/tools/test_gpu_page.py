# SPDX-License-Identifier: Apache-2.0
"""The page of counts for GPUs: its tables, a step by parts, and what is wanted."""

from __future__ import annotations

import gpu_page
from calls import refuses
from gpu_model import Stage

from clsplat.errors import ClsplatError


def test_tables_have_a_place_in_the_page() -> None:
    page = gpu_page.PAGE.read_text("utf-8")
    names = (
        "kernels",
        "pairs",
        "frames",
        "constants",
        "measured",
        "now",
        "wanted",
        "stages",
        "goals",
        "steps",
        "devices",
        "intel",
    )
    filled = gpu_page.fill_in(page, {name: f"table of {name}" for name in names})
    assert all(f"<!-- {name} -->\ntable of {name}\n<!-- end -->" in filled for name in names)
    refuses("has no place for the table costs", gpu_page.fill_in, page, {"costs": ""}, error=ClsplatError)


def predictions() -> dict[tuple[str, str, str], dict[str, Stage]]:
    step = {name: Stage(0.6, 0.5, 0.2, 1.0, 2) for name in ("target", "loss", "blend", "blend_grad", "project_grad")}
    return {
        (gpu_page.SHAPE, gpu.name, frame): step if frame == "large" else {"blend": Stage(ms=2.5)}
        for gpu in gpu_page.GPUS
        for frame in ("large", "picture")
    }


def test_a_step_by_parts() -> None:
    lines = gpu_page.stage_table(predictions(), "large").splitlines()
    assert len({line.count("|") for line in lines}) == 1
    (loss,) = [line for line in lines if line.startswith("| loss |")]
    assert loss.startswith("| loss | 4 | 1.20 | 1.00 | 0.40 | 2.00 | 2.00 |")  # target is of it
    assert lines[-1].startswith("| all | 10 | 3.00 | 2.50 | 1.00 | 5.00 | 5.00 |")
    refuses("stages turn: of no part in PARTS", gpu_page.parts_of, {"turn": Stage()}, error=ClsplatError)


def test_what_is_wanted() -> None:
    text = gpu_page.goals(predictions(), "large", "picture").replace("\n", " ")
    assert "**5.0 ms** (wanted: at most 8)" in text
    assert "**400 a second** (wanted: at least 400)" in text
    assert "all but blending and its gradient takes 3.0 ms here." in text
