# SPDX-License-Identifier: Apache-2.0
"""Every stage on frozen scenes against the float64 reference and stored digests: what of a driver can be trusted.

As a program it is the child that `clsplat.trust` starts, as a driver may crash or hang: it says in lines of JSON what
it is about to do and what came of it.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from clsplat.device.context import Device, all_devices
from clsplat.device.source import kernel_root
from clsplat.selftest_bench import Bench, Outcome, digest_of
from clsplat.selftest_scenes import scenes
from clsplat.selftest_stages import RUN
from clsplat.stages.blend import tile_items

FORWARD = ("arithmetic", "project", "duplicate", "sort", "ranges", "blend")
"""What a frame needs."""
STAGES = (*FORWARD, "loss", "blend_grad", "project_grad", "adam", "statistics")
INDICES = ("project", "duplicate", "sort", "ranges")
"""Those by whose counts and lists the next ones find their way."""

BOUNDS: dict[str, tuple[float, str]] = {
    "arithmetic": (3.01, "what OpenCL 1.2 allows a square root, 3 ulp; a division may have 2.5"),
    "project": (256, "30 found, at opacities near 1; six times that for roots and divisions of 3 ulp, not 0.5"),
    "duplicate": (0, "whole numbers"),
    "sort": (0, "whole numbers"),
    "ranges": (0, "whole numbers"),
    "blend": (256, "11 found; 256 are 1.5e-5 of a colour of 0.5, under the 2e-5 that a frame may be off"),
    "loss": (128, "9 found; the SSIM's quotients may have six times that"),
    "blend_grad": (1024, "32 found; up to 64 divisions one after the other recover the transmittance"),
    "project_grad": (512, "39 found, at opacities near 1; six times that for sloppy divisions"),
    "adam": (32, "2 found; one root and one division"),
    "statistics": (32, "1 found; one root"),
}
"""Ulp that a stage may be off, and why: what is found where every operation is rounded as IEEE 754 has it, with room
for a GPU whose divisions and roots are not. A wrong operation is off by thousands."""
DIGESTS = Path(__file__).with_name("selftest.json")


@dataclass(frozen=True)
class Result:
    """What a stage came to, over all frozen scenes: the worst error as it is and in ulp; the bound in ulp; whether the
    bits are those of the stored digest (None: none is stored for this shape); ms of all scenes; and in words what is
    wrong beside the error, or empty.

    where: what the worst error in ulp is of; otherwise: operations that round in another way than IEEE 754's."""

    stage: str
    absolute: float
    ulp: float
    bound: float
    same_bits: bool | None
    ms: float
    trouble: str
    where: str
    otherwise: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether the stage can be trusted. Other bits alone do not condemn it."""
        return not self.trouble and self.ulp <= self.bound


@cache
def stored_digests() -> dict[str, Any]:
    """By scene and stage: of all drivers and shapes, or by shape where the order of sums is the shape's."""
    found: dict[str, Any] = json.loads(DIGESTS.read_text())["digests"]
    return found


def shape_label(device: Device) -> str:
    """Lanes and items as the gradient's sums go."""
    return f"{device.shape.lanes}x{tile_items(device)}"


def run(
    device: Device,
    *,
    quick: bool = False,
    stages: Sequence[str] = STAGES,
    say: Callable[[str], None] = lambda name: None,
    found: dict[str, str] | None = None,
) -> Iterator[Result]:
    """The stages one after the other, each on all scenes; it ends early where the next would read or write beside its
    arrays.

    say: is told the stage that begins. found: gets the digests by "scene/stage".
    """
    benches = [Bench(device, frozen) for frozen in scenes(quick=quick)]
    for name in stages:
        say(name)
        outcomes = []
        for bench in benches:
            try:
                outcomes.append(RUN[name](bench))
            except Exception as error:  # noqa: BLE001  # drivers, and sizes that a wrong kernel has made, raise anything
                text = " ".join(str(error).split())[:300]
                outcomes.append(Outcome([], {}, 0.0, f"{type(error).__name__}: {text}"))
        if found is not None:
            names = [f"{bench.frozen.name}/{name}" for bench in benches]
            found.update({key: digest_of(each.arrays) for key, each in zip(names, outcomes, strict=True)})
        result = _result(name, benches, outcomes)
        yield result
        if result.trouble and name in INDICES:
            return


def _result(name: str, benches: list[Bench], outcomes: list[Outcome]) -> Result:
    errors = [(ulp, absolute, of) for each in outcomes for of, (absolute, ulp) in each.errors.items()]
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
        ms=sum(each.ms for each in outcomes),
        trouble=next((each.trouble for each in outcomes if each.trouble), ""),
        where=where,
        otherwise=outcomes[0].otherwise,
    )


MARK = "clsplat-selftest "
"""What a line that is meant for the parent begins with; drivers print lines of their own."""


def _child(index: int, shape: tuple[int, int], *, quick: bool, forward: bool) -> None:
    """Build and run on the `index`-th device; a line of JSON for what begins, another for what came of it."""

    def tell(**values: object) -> None:
        print(MARK + json.dumps(values), flush=True)

    tell(begins="opening the device")
    device = Device(all_devices()[index]).with_shape(lanes=shape[0], items=shape[1])
    stages = FORWARD if forward else STAGES
    if not quick:
        start = time.perf_counter()
        for path in sorted(kernel_root().glob("*.cl")):
            tell(begins=f"building {path.name}")
            device.kernels(path.stem)
        tell(built=time.perf_counter() - start)
    for result in run(device, quick=quick, stages=stages, say=lambda name: tell(begins=name)):
        tell(result=asdict(result))
    tell(done=True)


if __name__ == "__main__":
    given = sys.argv[1:]
    _child(int(given[0]), (int(given[1]), int(given[2])), quick="quick" in given, forward="forward" in given)
