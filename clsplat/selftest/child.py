# SPDX-License-Identifier: Apache-2.0
"""Every stage on frozen scenes against the float64 reference and stored digests: a test of what a driver computes.

As a program it is the child that `clsplat.selftest.trust` starts, as a driver may crash or hang: it says in lines of
JSON what it is about to do and what came of it.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any

from clsplat.device.child import end_with_parent, tell
from clsplat.device.context import Device, all_devices
from clsplat.device.source import kernel_root
from clsplat.errors import DriverError
from clsplat.selftest.harness import Bench, Outcome, digest_of
from clsplat.selftest.result import BOUNDS, INDICES, STAGES, Result
from clsplat.selftest.scenes import scenes
from clsplat.selftest.stages import RUN
from clsplat.stages.blend import tile_items
from clsplat.stages.channels import WIDTHS, Features

DIGESTS = Path(__file__).with_name("digests.json")
_FEATURES = Features.of(WIDTHS).defines
BUILT_WITH: dict[str, dict[str, object]] = {
    "features": {**_FEATURES, "LANES": 1},
    "channels": _FEATURES,
    "appearance": {"LANES": 1},
    "grid": {"LANES": 1},
    "noise": {"LANES": 1},
    "pose": {"LANES": 1},
    "project_rays": {"LANES": 1, "RAYS": 1},
    "sampling": {"LANES": 1},
    "splats_grad": {"LANES": 1, "VALUES": 3},
    "values": {"VALUES": 3},
    "values_grad": {"VALUES": 3, "GEOMETRY": True},
}
"""Defines of the kernels that are not built without."""


@cache
def stored_digests() -> dict[str, Any]:
    """Digests by scene and stage: of all drivers and shapes, or by shape where the order of sums is the shape's."""
    digests: dict[str, Any] = json.loads(DIGESTS.read_text())["digests"]
    return digests


def shape_label(device: Device) -> str:
    """Lanes and items as the gradient's sums go."""
    return replace(device.shape, items=tile_items(device), subgroups=False).label


def run(
    device: Device,
    *,
    quick: bool = False,
    stages: Sequence[str] = STAGES,
    say: Callable[[str], None] = lambda name: None,
    digests: dict[str, str] | None = None,
) -> Iterator[Result]:
    """The stages one after the other, each on all scenes; it ends early where the next would read or write beside its
    arrays.

    say: is told the stage that begins. digests: gets those of this run by "scene/stage".
    """
    benches = [Bench(device, frozen) for frozen in scenes(quick=quick)]
    for name in stages:
        say(name)
        outcomes = []
        for bench in benches:
            try:
                outcomes.append(RUN[name](bench))
            except DriverError:  # in another shape it may work
                raise
            except Exception as error:  # noqa: BLE001  # drivers, and sizes that a wrong kernel has made, raise anything
                text = " ".join(str(error).split())[:300]
                outcomes.append(Outcome(trouble=f"{type(error).__name__}: {text}"))
        if digests is not None:
            for bench, outcome in zip(benches, outcomes, strict=True):
                digests[f"{bench.frozen.name}/{name}"] = digest_of(outcome.arrays)
        result = _result(name, benches, outcomes)
        yield result
        if result.trouble and name in INDICES:
            return


def _result(name: str, benches: list[Bench], outcomes: list[Outcome]) -> Result:
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
        bound=BOUNDS[name][0],
        same_bits=False if False in same else (None if None in same else True),
        ms=sum(outcome.ms for outcome in outcomes),
        trouble=next((outcome.trouble for outcome in outcomes if outcome.trouble), ""),
        where=where,
        otherwise=outcomes[0].otherwise,
    )


def _child(index: int, shape: str, stages: Sequence[str], *, quick: bool) -> None:
    """Build and run on the `index`-th device; a line of JSON for what begins, another for what came of it."""
    end_with_parent()
    tell(begins="opening the device")
    device = Device(all_devices()[index]).with_shape(shape)
    device.rehearsal.say = lambda kernel: tell(begins=kernel)
    try:
        if not quick:
            start = time.perf_counter()
            for path in sorted(kernel_root().glob("*.cl")):
                device.kernels(path.stem, **BUILT_WITH.get(path.stem, {}))
            tell(built=time.perf_counter() - start)
        digests: dict[str, str] = {}
        for result in run(device, quick=quick, stages=stages, say=lambda name: tell(begins=name), digests=digests):
            tell(result=asdict(result), digests=digests)
    except DriverError as error:
        tell(failed=str(error))
    else:
        tell(done=device.rehearsal.done)


if __name__ == "__main__":
    which, label, names, *flags = sys.argv[1:]
    _child(int(which), label, names.split(","), quick="quick" in flags)
