# SPDX-License-Identifier: Apache-2.0
"""Complete a trial away from the GPU: counted instructions, predictions, and its row of docs/gpus/calibration.json."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import gpu_static
from gpu_compilers import ask_package
from gpu_devices import Gpu, gpu_of
from gpu_loops import UnknownLoopError
from gpu_measured import CALIBRATION, fit_constants, read, with_inputs
from gpu_model import Work, works_of
from measuring import require
from trial_variants import USUAL_SHAPE, VARIANTS, Variant

from clsplat.files.atomic import atomic_write


@contextmanager
def _text_of(variant: Variant) -> Iterator[None]:
    """A context manager, inside which compilers use the variant's kernel text. If it differs from the usual text, the
    cache of compiled kernels is cleared before and after."""
    if not variant.text:
        yield
        return
    gpu_static._COMPILED.clear()  # noqa: SLF001  # keyed by options, not by text
    with variant.changed_text():
        yield
    gpu_static._COMPILED.clear()  # noqa: SLF001


def works_of_variant(variant: Variant, target: str, frames: Sequence[Mapping[str, Any]]) -> list[list[Work | None]]:
    """The work of each frame's launches, in a variant's form. Raises ClsplatError."""
    steps = ask_package(f"variant {VARIANTS.index(variant)}", frames)
    sources = gpu_static.sources_of(launch for step in steps for launch in step)
    with _text_of(variant):
        rows = gpu_static.compiled(sources, [target], os.cpu_count() or 1, gpu_static.note, frames[-1])
        built = {(row.source, row.built.kernel): row.built for row in rows}
        return [works_of(step, built, frame) for frame, step in zip(frames, steps, strict=True)]


def gpu_in(record: Mapping[str, Any]) -> Gpu:
    """The GPU of a trial. Raises InputError for a device that the model does not know."""
    gpu = gpu_of(record["device"])
    require(gpu is not None, f"{record['device']}: not among GPUS in gpu_devices.py, so nothing is predicted or kept")
    assert gpu is not None
    return gpu


def count_variants(record: dict[str, Any]) -> None:
    """Add `counted`, millions of warp instructions, and `predicted_ms` to the rows of a trial's variants.

    The model's constants are fitted to calibration.json as it is, without this trial. Raises ClsplatError."""
    gpu, calibration = gpu_in(record), json.loads(CALIBRATION.read_text("utf-8"))
    constants = fit_constants(calibration, read(calibration, {})[0])
    frames = _frames(dict.fromkeys(row["scene"] for row in record["variants"]))
    for variant in VARIANTS:
        measured = (row for row in record["variants"] if row["variant"] == variant.name)
        rows = [row for row in measured if variant.measures(row["stage"], row["kernel"])]
        if not rows:
            continue
        try:
            works_of_frames = works_of_variant(variant, gpu.target, frames)
        except UnknownLoopError as error:  # `works_of` has no rules for blend_grad with a Gaussian per item
            gpu_static.note(f"{variant.title}: not predicted: {error}")
            continue
        found = {frame["name"]: works for frame, works in zip(frames, works_of_frames, strict=True)}
        for row in rows:
            works = [
                work
                for work in found[row["scene"]]
                if work is not None and (work.stage, work.kernel) == (row["stage"], row["kernel"])
            ]
            if works:
                row["counted"] = 1e-6 * sum(work.instructions for work in works)
                row["predicted_ms"] = sum(work.on(gpu, constants).ms for work in works)


def _frames(names: Iterator[str] | Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The rows of gpu_frames.json of these names, in their order."""
    known = {frame["name"]: frame for frame in json.loads(gpu_static.FRAMES.read_text("utf-8"))["frames"]}
    missing = [name for name in names if name not in known]
    require(not missing, f"{', '.join(missing)}: not in {gpu_static.FRAMES.name}, which gpu_frames.py completes")
    return [known[name] for name in names]


def row_of(record: Mapping[str, Any]) -> dict[str, Any]:
    """The trial's row of calibration.json, without the model's inputs.

    Times of kernels are those of the usual form among the variants, which are all times of a step. The stages of
    `bench` are not used, as they mix a frame's lists with a step's.
    """
    left_out = ("shape", "host_ms", "frame_ms")  # a frame has other launches than the step of the inputs
    usual = [each for each in record["variants"] if each["variant"] == USUAL_SHAPE]
    scenes = [
        {name: value for name, value in scene.items() if name not in left_out}
        | {"kernels_ms": {f"{k['stage']}: {k['kernel']}": k["ms"] for k in usual if k["scene"] == scene["frame"]}}
        for scene in record["scenes"]
        if scene["shape"] == USUAL_SHAPE
    ]
    same = {name: record[name] for name in ("device", "driver", "date", "commit", "shape")}
    limits = {name: round(value, 3) for name, value in record["limits"].items()}
    return {"device": same.pop("device"), "gpu": gpu_in(record).name, **same, "limits": limits, "scenes": scenes}


def add_row(record: Mapping[str, Any]) -> None:
    """Add a trial's row to calibration.json, with the inputs of the present kernels. It replaces a row of the same
    device, date and commit."""
    row, target = row_of(record), gpu_in(record).target
    frames = _frames({scene["frame"]: None for scene in row["scenes"]})
    usual = VARIANTS[0]
    works = works_of_variant(usual, target, frames)
    key = ("device", "date", "commit")
    rows = [each for each in json.loads(CALIBRATION.read_text("utf-8")) if any(each[name] != row[name] for name in key)]
    by_frame = {(target, frame["name"]): each for frame, each in zip(frames, works, strict=True)}
    atomic_write(CALIBRATION, with_inputs([*rows, row], by_frame).encode())
