# SPDX-License-Identifier: Apache-2.0
"""Read the measured steps of docs/gpus/calibration.json, and compare them with the model's predictions.

A row of the file has a device, its driver, date and commit, and scenes. Of a scene, `frame` is its name in
gpu_frames.json, `parts_ms` or `kernels_ms` are times on the device, and `frame_ms` and `step_ms` are wall times.
`inputs` are the model's inputs for the step's launches, from the code that was measured. So a row stays a test of the
model when kernels change. After a change to the model, `gpu_static.py --inputs` counts inputs anew (`gpu_recount.py`).
Rows without inputs, or of a device that is not in `gpu_devices.py`, are not used.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gpu_chain import Chain
from gpu_devices import GPUS, Gpu
from gpu_model import Constants, Stage, Work, fit, stages_of, wall

CALIBRATION = Path(__file__).resolve().parents[2] / "docs/gpus/calibration.json"
DIGITS = 6
"""Number of significant digits of a row's inputs."""
WITHIN = {"made up, 1 M": 0.25, "fox, step 7000": 0.4}
"""Maximum relative difference between prediction and measurement, by frame. Other frames are held out of the fit."""
PARTS = {
    "project": ("project",),
    "lists and sorts": ("duplicate", "ranges", "append"),
    "blend": ("blend",),
    "loss": ("target", "loss"),
    "blend_grad": ("blend_grad",),
    "project_grad, Adam": ("project_grad", "adam"),
    "statistics": ("statistics",),
}
"""Parts of a step, with the names of their stages."""
ATOMICS = (1450, 6700)
"""Numbers of global counters for which the time of atomics was measured."""
OF_FRAME = ("project", "duplicate", "ranges", "blend")
"""Stages of a frame."""
WALLS = ("frame, wall", "step, wall")
DRAWN = ", drawn"
"""Suffix of a frame's name for the launches that only draw it. They make lists differently from a step by capacity."""


@dataclass(frozen=True)
class Measured:
    """A measured scene of a row of calibration.json.

    code: commit and date.
    ms: measured milliseconds, by part and WALLS.
    works: the work of the launches that were measured.
    now: the work of the present kernels' launches, if the frame has counts.
    drawn: the work of present launches that only draw the frame.
    """

    gpu: Gpu
    frame: str
    code: str
    ms: Mapping[str, float]
    works: Sequence[Work | None]
    now: Sequence[Work | None] = ()
    drawn: Sequence[Work | None] = ()

    def predicted(self, constants: Constants) -> dict[str, float]:
        """Predicted milliseconds of everything that was measured."""
        found = milliseconds(self.works, self.gpu, constants)
        return {name: found[name] for name in self.ms}


def milliseconds(
    works: Sequence[Work | None], gpu: Gpu, constants: Constants, drawn: Sequence[Work | None] = ()
) -> dict[str, float]:
    """Predicted milliseconds of PARTS and WALLS. works: of a step. drawn: of a frame; if empty, those of the step."""
    stages = stages_of(works, gpu, constants)
    found = {
        part: sum((stages[name] for name in members if name in stages), Stage()).ms for part, members in PARTS.items()
    }
    drawn = drawn or [work for work in works if work is None or work.stage in OF_FRAME]
    for name, each in zip(WALLS, (drawn, filter(None, works)), strict=True):
        found[name] = wall(each, gpu, constants)
    return found


Works = Mapping[tuple[str, str], Sequence[Work | None]]
"""The work of a step's launches, by target or GPU, and by frame."""


def inputs_of(works: Iterable[Work | None]) -> list[Any]:
    """A step's launches as `inputs` of a scene, without the fields that have the defaults of Work."""

    def told(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: told(each) for key, each in value.items()}
        return value if isinstance(value, str) else float(f"{value:.{DIGITS}g}")

    usual = asdict(Work("", 0))
    found = [work and asdict(work) for work in works]
    return [work and told({key: each for key, each in work.items() if each != usual[key]}) for work in found]


def with_inputs(rows: Sequence[Mapping[str, Any]], works: Works) -> str:
    """Text of calibration.json, with inputs added to scenes that have none. works: of the code that was measured."""
    inputs, rows = [], deepcopy(rows)
    for row in rows:
        target = next((each.target for each in GPUS if each.name == row.get("gpu")), "")
        for scene in row["scenes"]:
            found = scene.get("inputs")
            if found is None and (target, scene.get("frame")) in works:
                found = inputs_of(works[target, scene["frame"]])
            if found is not None:
                inputs.append(",\n".join(f"     {json.dumps(each)}" for each in found))
                scene["inputs"] = f"inputs {len(inputs) - 1}"
    text = json.dumps(rows, indent=1)
    return re.sub(r'"inputs (\d+)"', lambda match: f"[\n{inputs[int(match[1])]}\n    ]", text) + "\n"


def _work(given: Mapping[str, Any] | None) -> Work | None:
    """The work of a launch from an entry of `inputs`."""
    chains = {name: Chain(**given[name]) for name in ("chain", "longest") if name in given} if given else {}
    return None if given is None else Work(**{**given, **chains})


def read(rows: Sequence[Mapping[str, Any]], now: Works) -> tuple[list[Measured], list[str]]:
    """The scenes that can be compared, and descriptions of rows and scenes that are not used.

    now: work of the present kernels, by GPU and frame.
    """
    found, unused = [], []
    of_stage = {stage: part for part, members in PARTS.items() for stage in members}
    for row in rows:
        gpu = next((each for each in GPUS if each.name == row.get("gpu")), None)
        if gpu is None:
            unused.append(f"{row['device']}: unknown device")
            continue
        code = f"{row['commit']} of {row['date']}"
        for scene in row["scenes"]:
            if "inputs" not in scene:
                unused.append(f"{row['device']}, {row['date']}: {scene['scene']} has no inputs")
                continue
            works = [_work(each) for each in scene["inputs"]]
            stage_of = {work.kernel: work.stage for work in works if work}
            parts = dict(scene.get("parts_ms", {}))
            for name, ms in scene.get("kernels_ms", {}).items():
                stage, colon, _ = name.partition(":")
                part = of_stage.get(stage if colon else stage_of.get(name, ""), "")
                parts[part] = parts.get(part, 0) + ms
            parts = {part: parts[part] for part in PARTS if part in parts}
            walls = zip(WALLS, ("frame_ms", "step_ms"), strict=True)
            parts |= {wall: scene[key] for wall, key in walls if key in scene}
            today = (now.get((gpu.name, scene["frame"] + suffix), ()) for suffix in ("", DRAWN))
            found.append(Measured(gpu, scene["frame"], code, parts, works, *today))
    return found, unused


Fit = tuple[Sequence[Measured], Constants, Sequence[str], Works]
"""Scenes that were measured, the constants, descriptions of rows that are not used, and the work of present kernels."""


def fit_constants(rows: Sequence[Mapping[str, Any]], measured: Sequence[Measured]) -> Constants:
    """The constants that fit the measured frames of WITHIN best: least squares of log(predicted / measured).

    Constants that small kernels have measured are taken from the rows.
    """
    limits = next(row["limits"] for row in rows if "limits" in row and "copy float4 x1, 1024" in row["limits"])
    gpu = next(each for row in rows if row.get("limits") is limits for each in GPUS if each.name == row["gpu"])
    few, many = (limits[f"3.4 M atomic_inc on {counters}, ms"] / 3.4 for counters in ATOMICS)  # nanoseconds
    counter = (few - many) / (1 / ATOMICS[0] - 1 / ATOMICS[1])
    begin = Constants(
        copy=limits["copy float4 x1, 1024"] / gpu.gb,
        groups=limits["groups G/s, 64"] * 1e3 / limits["clock"],
        atomic=many - counter / ATOMICS[1],
        counter=counter,
    )

    def error(constants: Constants) -> float:
        return sum(math.log(ms / each.ms[name]) ** 2 for each in used for name, ms in each.predicted(constants).items())

    used = [each for each in measured if each.frame in WITHIN]
    return fit(error, begin) if used else begin


def beyond(measured: Sequence[Measured], constants: Constants) -> list[str]:
    """Descriptions of predictions that differ from the measurement by more than WITHIN allows."""
    return [
        f"{each.frame}, {each.gpu.name}, {name}: {ms:.3f} ms predicted, {each.ms[name]:.3f} measured, expected within "
        f"{WITHIN[each.frame]:.0%}"
        for each in measured
        if each.frame in WITHIN
        for name, ms in each.predicted(constants).items()
        if abs(ms / each.ms[name] - 1) > WITHIN[each.frame]
    ]
