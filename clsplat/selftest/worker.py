# SPDX-License-Identifier: Apache-2.0
"""Run the self-test: every stage on frozen scenes, compared with the float64 reference and with stored digests.

As a program, this module is the worker process of `clsplat.selftest.driver_check`: a driver may crash it or make it
hang. The process reports its steps and results as lines of JSON.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path

from clsplat.camera import CAMERA_MODELS
from clsplat.device.context import Device, all_devices
from clsplat.device.drivers.worker_process import end_with_parent, tell
from clsplat.device.source import kernel_root
from clsplat.errors import DriverError
from clsplat.selftest.cases.table import OUTCOMES_BY_STAGE
from clsplat.selftest.harness import CaseBench, StageOutcome, digest_of
from clsplat.selftest.result import INDEX_STAGES, SELFTEST_STAGES, STAGE_BOUNDS_ULP, Result
from clsplat.selftest.scenes import scenes
from clsplat.stages.blend import tile_items
from clsplat.stages.channels import FEATURE_WIDTHS, Features
from clsplat.stages.project import CPU_STEP_ROWS

DIGESTS_PATH = Path(__file__).with_name("digests.json")
_FEATURE_DEFINES = Features.of(FEATURE_WIDTHS).defines
DEFAULT_DEFINES: dict[str, dict[str, object]] = {
    "features": {**_FEATURE_DEFINES, "LANES": 1},
    "channels": _FEATURE_DEFINES,
    "appearance": {"LANES": 1},
    "deep_merge": {"LANES": 1},
    "grid": {"LANES": 1},
    "noise": {"LANES": 1},
    "settle": {"LANES": 1},
    "catch_up": {"ROWS": CPU_STEP_ROWS},
    "pose": {"LANES": 1},
    "probe_atomics": {"PROBED": 1},
    "project_rays": {"LANES": 1, **next(model.defines for model in CAMERA_MODELS if model.along_rays)},
    "sampling": {"LANES": 1},
    "splats_grad": {"LANES": 1, "VALUES": 3},
    "values": {"VALUES": 3},
    "values_grad": {"VALUES": 3, "GEOMETRY": True},
}
"""Preprocessor defines without which a kernel file cannot be built, by the file's name without ".cl"."""


@cache
def stored_digests() -> dict[str, str | dict[str, str]]:
    """The stored digests by "scene/stage".

    A stage has one digest for all drivers and kernel shapes, or one for each shape if the order of its sums depends on
    the shape.
    """
    digests: dict[str, str | dict[str, str]] = json.loads(DIGESTS_PATH.read_text())["digests"]
    return digests


def shape_label(device: Device) -> str:
    """The label of the device's kernel shape in digests.json.

    In this label, the number of items is the number of work-items that share a tile. The label does not tell whether
    work-items sum within sub-groups.
    """
    return replace(device.shape, items=tile_items(device), subgroups=False).label


def run(
    device: Device,
    *,
    quick: bool = False,
    stages: Sequence[str] = SELFTEST_STAGES,
    say: Callable[[str], None] = lambda name: None,
    digests: dict[str, str] | None = None,
) -> Iterator[Result]:
    """Run the stages in order, each on all scenes, and yield their results.

    The run ends early if the next stage could read or write outside its arrays because of wrong indices.

    say: function that is called with the name of each stage before it runs.
    digests: dictionary that is filled with the digests of this run, by "scene/stage".
    """
    benches = [CaseBench(device, frozen) for frozen in scenes(quick=quick)]
    for name in stages:
        say(name)
        outcomes = []
        for bench in benches:
            try:
                outcomes.append(OUTCOMES_BY_STAGE[name](bench))
            except DriverError:  # ends the run, as the caller may try another kernel shape
                raise
            except Exception as error:  # noqa: BLE001
                # A driver may raise any exception, and so may code that uses wrong sizes from a faulty kernel.
                text = " ".join(str(error).split())[:300]
                outcomes.append(StageOutcome(trouble=f"{type(error).__name__}: {text}"))
        if digests is not None:
            for bench, outcome in zip(benches, outcomes, strict=True):
                digests[f"{bench.frozen.name}/{name}"] = digest_of(outcome.arrays)
        result = _result(name, benches, outcomes)
        yield result
        if result.trouble and name in INDEX_STAGES:
            return


def _result(name: str, benches: list[CaseBench], outcomes: list[StageOutcome]) -> Result:
    errors = [(ulp, absolute, place) for outcome in outcomes for place, (absolute, ulp) in outcome.errors.items()]
    ulp, _, where = max(errors, default=(0.0, 0.0, ""))
    same: list[bool | None] = []
    for bench, outcome in zip(benches, outcomes, strict=True):
        stored = stored_digests().get(f"{bench.frozen.name}/{name}")
        if isinstance(stored, dict):
            stored = stored.get(shape_label(bench.device))
        same.append(None if stored is None else stored == digest_of(outcome.arrays))
    return Result(
        stage=name,
        absolute=max((absolute for _, absolute, _ in errors), default=0.0),
        ulp=ulp,
        bound=STAGE_BOUNDS_ULP[name][0],
        same_bits=False if False in same else (None if None in same else True),
        ms=sum(outcome.ms for outcome in outcomes),
        trouble=next((outcome.trouble for outcome in outcomes if outcome.trouble), ""),
        where=where,
        otherwise=outcomes[0].otherwise,
    )


def _child(index: int, shape: str, stages: Sequence[str], *, quick: bool) -> None:
    """Build all kernels and run the stages on the `index`-th device, in the kernel shape with the label `shape`.

    Prints a line of JSON before each step and for each result.

    quick: use only the two smaller frozen scenes, and build only the kernels that the stages use.
    """
    end_with_parent()
    tell(begins="opening the device")
    device = Device(all_devices()[index]).with_shape(shape)
    device.trials.say = lambda kernel: tell(begins=kernel)
    try:
        if not quick:
            start = time.perf_counter()
            for path in sorted(kernel_root().glob("*.cl")):
                device.kernels(path.stem, DEFAULT_DEFINES.get(path.stem, {}))
            tell(built=time.perf_counter() - start)
        digests: dict[str, str] = {}
        for result in run(device, quick=quick, stages=stages, say=lambda name: tell(begins=name), digests=digests):
            tell(result=asdict(result), digests=digests)
    except DriverError as error:
        tell(failed=str(error))
    else:
        tell(done=device.trials.known)


if __name__ == "__main__":
    which, label, names, *flags = sys.argv[1:]
    _child(int(which), label, names.split(","), quick="quick" in flags)
