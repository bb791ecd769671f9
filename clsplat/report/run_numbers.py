# SPDX-License-Identifier: Apache-2.0
"""Numbers of a run, read from metrics.jsonl, eval.json and model.ply, for the HTML reports.

Nothing is measured again. Missing or damaged files are reported as notes.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError, plain
from clsplat.files.documents import digest, parse_json, read_document
from clsplat.gaussians import Gaussians, GaussiansOfFile
from clsplat.runs.run import Run
from clsplat.scenes.geography.georeference import GEOREFERENCE_FILE, read_georeference

Record = dict[str, Any]

SCORE_NAMES = ("psnr", "ssim", "lpips")
CURVE_KEYS = ("step", "loss", "psnr", "gaussians", "seconds")
"""Keys of every record in metrics.jsonl."""
MAX_NAME_CHARACTERS = 200
"""Maximum number of characters of a displayed name of a view, stage or device."""
MAX_EVALUATED_VIEWS, MAX_STAGES, MAX_SESSIONS, MAX_SAMPLES = 10_000, 40, 100, 2000
"""Maximum numbers of views in an evaluation, of stages of a step, of training sessions, and of records of stages or
evaluations that are read from files. clsplat writes fewer; the limits protect from files of other programs."""
MAX_DRAWN_VALUE = 1e30
"""Largest magnitude of a number in a chart."""


@dataclass
class RunNumbers:
    """Numbers of a run, from its files.

    curves: for each of CURVE_KEYS, the values in all records of metrics.jsonl.
    stages: for each measured step, a record with its number and the milliseconds of each stage.
    evaluations: held-out scores during training and at its end, in the order of steps.
    evaluation: contents of eval.json.
    sessions: start, device, driver and versions of each training session.
    elapsed: wall time of all training sessions in seconds; None if unknown.
    model: description of model.ply, without its Gaussians.
    place: reference system, origin and GPS residuals of the model's place on the earth; None if the place is unknown.
    histograms: edges and counts of each histogram, by name.
    notes: sentences on missing or damaged data, and other remarks.
    """

    run: Run
    name: str
    curves: dict[str, list[float]]
    stages: list[Record] = field(default_factory=list)
    evaluations: list[Record] = field(default_factory=list)
    evaluation: Record | None = None
    sessions: list[Record] = field(default_factory=list)
    elapsed: float | None = None
    model: Record | None = None
    place: str | None = None
    histograms: dict[str, Record] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def step(self) -> int:
        """The last step that metrics.jsonl or an evaluation records, whichever is later; 0 if there is none."""
        steps = [self.curves["step"][-1]] if self.curves["step"] else []
        return int(max([*steps, *(record["step"] for record in self.evaluations)], default=0))

    @property
    def seconds(self) -> float | None:
        """Seconds of training so far."""
        known = self.evaluation["seconds"] if self.evaluation else None
        return known if known is not None else next(reversed(self.curves["seconds"]), None)

    @property
    def gaussians(self) -> int | None:
        """Number of Gaussians in the model: from model.ply, else from eval.json, else from the last record."""
        for record in (self.model, self.evaluation):
            if record is not None and record["gaussians"] is not None:
                return int(record["gaussians"])
        last = next(reversed(self.curves["gaussians"]), None)
        return None if last is None else int(last)

    def held_out(self, x: str) -> list[tuple[float, float]]:
        """Points (x, PSNR of the held-out views) of the evaluations that have both. `x` is "seconds" or "step"."""
        points = [(evaluation.get(x), evaluation.get("psnr")) for evaluation in self.evaluations]
        return [(float(at), psnr) for at, psnr in points if at is not None and psnr is not None]

    def document(self) -> Record:
        """Return all numbers as a JSON object, for --json."""
        document = {item.name: getattr(self, item.name) for item in fields(self) if item.name != "run"}
        scene = self.run.scene.name if self.run.scene is not None else None
        return {**document, "settings": asdict(self.run.config), "scene": scene}


def read_run_numbers(run: Run, model: Gaussians | None = None, *, describe: bool = True) -> RunNumbers:
    """Read all numbers of a run folder.

    model: contents of model.ply, if already loaded.
    describe: True to read model.ply and describe it.
    Raises InputError if metrics.jsonl cannot be read. Other missing or damaged data is reported as a note.
    """
    records = [
        record for record in run.read_metrics() if all(number(record.get(name)) is not None for name in CURVE_KEYS)
    ]
    curves = {name: [float(record[name]) for record in records] for name in CURVE_KEYS}
    numbers = RunNumbers(run, run.path.resolve().name, curves)
    for record in records:
        stages = record.get("stages")
        if isinstance(stages, dict) and (times := _numbers(stages, MAX_STAGES)).get("all"):
            numbers.stages.append({"step": int(record["step"]), "ms": times})
        if (evaluation := _evaluation(record.get("eval"))) is not None:
            numbers.evaluations.append({**_summary(evaluation), "step": int(record["step"])})
        if isinstance(session := record.get("session"), dict):
            numbers.sessions.append(_session(session))
    for listed in (numbers.stages, numbers.evaluations):
        del listed[:-MAX_SAMPLES]
    del numbers.sessions[:-MAX_SESSIONS]
    numbers.elapsed = _elapsed(records)
    _add_evaluation(numbers)
    if describe:
        _add_model(numbers, model)
    _add_place(numbers)
    _add_contributions(numbers, records)
    _add_gate(numbers, records)
    iterations = run.config.iterations
    if numbers.step < iterations:
        numbers.notes.insert(0, f"Not finished: the run is at step {numbers.step:,} of {iterations:,}.")
    if not records:
        numbers.notes.append("metrics.jsonl has no records: there are no curves.")
    elif not numbers.sessions:
        numbers.notes.append("An earlier version wrote this run: device, stage times and contributions are unknown.")
    else:
        if not numbers.stages:
            numbers.notes.append("The time of each stage was not measured (--stages-every 0).")
        if "contribution" not in numbers.histograms and numbers.step >= iterations:
            numbers.notes.append("Contributions were not measured: --no-report was set, or device memory was limited.")
    return numbers


def number(value: object) -> float | None:
    """Return `value` as a float if it is a number that charts can show, otherwise None."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if -MAX_DRAWN_VALUE <= value <= MAX_DRAWN_VALUE else None


def settings_of(config: object, prefix: str = "--") -> Iterator[tuple[str, Any]]:
    """Yield the name of the flag and the value of each setting in the dataclass `config`.

    prefix: text before the setting's name in a flag.
    """
    for setting in fields(config):  # type: ignore[arg-type]  # every caller passes a dataclass
        value, name = getattr(config, setting.name), prefix + setting.name.replace("_", "-")
        if is_dataclass(value):
            yield from settings_of(value, f"{name}.")
        else:
            yield name, value


def smooth(values: list[float], count: int) -> list[float]:
    """Moving average over `count` values, or over fewer values at both ends."""
    sums = np.concatenate([[0.0], np.cumsum(np.asarray(values, np.float64))])
    at = np.arange(len(values))
    low, high = np.maximum(at - count // 2, 0), np.minimum(at + count // 2 + 1, len(values))
    means: list[float] = ((sums[high] - sums[low]) / (high - low)).tolist()
    return means


def _texts(values: Mapping[str, Any]) -> Record:
    pairs = list(values.items())[:MAX_STAGES]
    return {name[:MAX_NAME_CHARACTERS]: value[:MAX_NAME_CHARACTERS] for name, value in pairs if isinstance(value, str)}


def _numbers(values: Mapping[str, Any], limit: int) -> dict[str, float]:
    numbers = {name[:MAX_NAME_CHARACTERS]: number(value) for name, value in list(values.items())[:limit]}
    return {name: value for name, value in numbers.items() if value is not None}


def _evaluation(value: object) -> Record | None:
    """Return the valid parts of `value`, an evaluation in the format of eval.json; None for any other value."""
    if not isinstance(value, dict) or not isinstance(value.get("views"), list):
        return None
    views = []
    for view in value["views"][:MAX_EVALUATED_VIEWS]:
        if not isinstance(view, dict) or not isinstance(name := view.get("name"), str):
            return None
        views.append({"name": name, **_numbers({key: view.get(key) for key in SCORE_NAMES}, len(SCORE_NAMES))})
    mean, missing = value.get("mean"), value.get("lpips_missing")
    counts = {name: number(value.get(name)) for name in ("step", "gaussians")}
    return {
        **{name: None if count is None else int(count) for name, count in counts.items()},
        "seconds": number(value.get("seconds")),
        "mean": _numbers({key: mean.get(key) for key in SCORE_NAMES}, len(SCORE_NAMES))
        if isinstance(mean, dict)
        else {},
        "views": views,
        **({"lpips_missing": plain(missing)[:500]} if isinstance(missing, str) else {}),
    }


def _summary(evaluation: Record) -> Record:
    return {"seconds": evaluation["seconds"], "gaussians": evaluation["gaussians"], **evaluation["mean"]}


def _session(value: Mapping[str, Any]) -> Record:
    names = ("started", "device", "driver", "kind", "shape", "system")
    session: Record = _texts({name: value.get(name) for name in names})
    session["from_step"] = int(number(value.get("from_step")) or 0)
    session["memory_limit"] = number(value.get("memory_limit"))
    if isinstance(versions := value.get("versions"), dict):
        session["versions"] = _texts(versions)
    return session


def _elapsed(records: list[Record]) -> float | None:
    """Sum the wall time of all training sessions until the last record, in seconds; None if a record has no time."""
    total, last = 0.0, None
    for record in records:
        if "session" in record and last is not None:
            total += last
        last = number(record.get("elapsed"))
        if last is None:
            return None
    return None if last is None else total + last


def _add_evaluation(numbers: RunNumbers) -> None:
    run = numbers.run
    if not run.eval_path.exists():
        numbers.notes.append("eval.json is missing: the held-out views were not measured at the end.")
        return
    try:
        evaluation = _evaluation(parse_json(read_document(run.eval_path, "the evaluation of a run")))
    except (InputError, ValueError):
        evaluation = None
    if evaluation is None:
        numbers.notes.append("eval.json is damaged and was ignored.")
        return
    numbers.evaluation = evaluation
    if not evaluation["views"]:
        numbers.notes.append("eval.json has no held-out views.")
    if (step := evaluation["step"]) is None:
        return
    others = [other for other in numbers.evaluations if other["step"] != step]
    numbers.evaluations = sorted([*others, {**_summary(evaluation), "step": step}], key=lambda record: record["step"])
    last = numbers.curves["step"][-1] if numbers.curves["step"] else None
    if last is not None and step != last:
        numbers.notes.append(f"eval.json belongs to step {step:,}, but metrics.jsonl ends at step {int(last):,}.")


def _add_model(numbers: RunNumbers, model: Gaussians | None) -> None:
    path: Path = numbers.run.model_path
    if not path.exists():
        numbers.notes.append("model.ply is missing: the model cannot be described.")
        return
    if isinstance(model, GaussiansOfFile):
        numbers.notes.append("model.ply is larger than --max-host-mem and is not described here: use clsplat info.")
        return
    try:
        model = model or Gaussians.load(path)
        size, sha256 = path.stat().st_size, digest(path)
    except (InputError, OSError) as error:
        numbers.notes.append(f"model.ply cannot be read: {str(error).removeprefix(f'{path}: ')}")
        return
    numbers.model = {"gaussians": len(model), "sh_degree": model.sh_degree, "bytes": size, "sha256": sha256}
    scales = np.sort(model.log_scales, axis=1) / np.float32(np.log(10))
    low, high = (np.floor(scales.min() * 5) / 5, np.ceil(scales.max() * 5) / 5) if len(model) else (0.0, 1.0)
    edges = np.linspace(low, max(high, low + 0.2), 41)
    for name, axis in (("smallest scale", 0), ("largest scale", 2)):
        numbers.histograms[name] = _histogram(scales[:, axis], edges)
    opacities = 1 / (1 + np.exp(-np.clip(model.opacity_logits, -80, 80)))
    numbers.histograms["opacity"] = _histogram(opacities, np.linspace(0.0, 1.0, 41))


def _add_place(numbers: RunNumbers) -> None:
    try:
        place = read_georeference(numbers.run.path / GEOREFERENCE_FILE)
    except InputError as error:
        numbers.notes.append(f"{str(error).removeprefix(f'{numbers.run.path}{os.sep}')}.")
        return
    numbers.place = None if place is None else place.summary


def _histogram(values: NDArray[Any], edges: NDArray[np.float64]) -> Record:
    counts, _ = np.histogram(np.clip(values, edges[0], edges[-1]), edges)
    return {"edges": np.round(edges, 6).tolist(), "counts": counts.tolist()}


def _add_contributions(numbers: RunNumbers, records: list[Record]) -> None:
    record = records[-1].get("contributions") if records else None
    if not isinstance(record, dict):
        return
    edges, counts = _list(record.get("edges")), _list(record.get("counts"))
    sums = _list([record.get(name) for name in ("views", "of", "none")])
    if sums and len(edges) == len(counts) + 1 > 1 and edges == sorted(edges):
        views, total, none = map(int, sums)
        histogram = {"edges": edges, "counts": list(map(int, counts)), "views": views, "of": total, "none": none}
        numbers.histograms["contribution"] = histogram


def _add_gate(numbers: RunNumbers, records: list[Record]) -> None:
    """Add a note if the refinement of cameras ended early, because held-out views became worse."""
    gates = (gate for record in reversed(records) if isinstance(gate := record.get("gate"), dict))
    gate = next(gates, {})
    if (ended := number(gate.get("ended"))) is not None and (best := number(gate.get("best"))) is not None:
        numbers.notes.append(
            f"Refining the cameras made held-out views worse: refinement ended at step {ended:,.0f}, and the cameras "
            f"of step {best:,.0f} are used."
        )


def _list(value: object) -> list[float]:
    """Return `value` if it is a list of numbers, otherwise an empty list."""
    listed = value if isinstance(value, list) else []
    numbers = [known for item in listed if (known := number(item)) is not None]
    return numbers if len(numbers) == len(listed) else []
