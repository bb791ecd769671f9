# SPDX-License-Identifier: Apache-2.0
"""Run the experiments' trainings, each once or resumed, and read their models, evaluations and PSNR."""

from __future__ import annotations

import hashlib
import json
import sys
from argparse import Namespace
from collections.abc import Callable, Generator, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from clsplat.cli.main import main as clsplat
from clsplat.cli.session import Services
from clsplat.evaluation.held_out import EvaluatedModel, evaluate
from clsplat.gaussians import Gaussians
from clsplat.images.alpha import Image
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene, View

Rows = Generator[tuple[object, ...] | str, None, int | None]
"""Yields rows of tables, the first row of each being its head, and lines of text. Returns the exit status."""


@dataclass(frozen=True)
class Trained:
    """A finished training."""

    run: Path

    @property
    def model(self) -> Gaussians:
        """The model, read from its file."""
        return Gaussians.load(self.run / "model.ply")

    @property
    def last(self) -> dict[str, Any]:
        """The last evaluation; "mean" has the means over the held-out views."""
        return _json(self.run / "eval.json")

    def psnr_by_step(self) -> dict[int, float]:
        """Mean PSNR of the held-out views in dB, keyed by step."""
        lines = map(json.loads, (self.run / "metrics.jsonl").read_text("utf-8").splitlines())
        psnr = {line["step"]: line["eval"]["mean"]["psnr"] for line in lines if "eval" in line}
        return psnr | {self.last["step"]: self.last["mean"]["psnr"]}

    @property
    def appearance(self) -> dict[str, dict[str, list[float]]]:
        """Learnt appearance of each photograph, keyed by name."""
        photographs: dict[str, dict[str, list[float]]] = _json(self.run / "appearance.json")["photographs"]
        return photographs


def _json(path: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(path.read_text("utf-8"))
    return document


def words_of(settings: str, **usual: object) -> list[str]:
    """Arguments of `clsplat train` for settings `name=value,...`, which take precedence over the usual settings."""
    values = {name: str(value) for name, value in usual.items() if value is not None}
    for setting in filter(None, settings.split(",")):
        name, value = setting.split("=", 1)
        values[name] = value
    flags = ((f"--{name.replace('_', '-')}", value) for name, value in values.items())
    return [word for flag, value in flags for word in ((flag,) if value.lower() == "true" else (flag, value))]


def trained(
    given: Namespace, name: str, scene: Path | Scene, *words: str, settings: str = "", **usual: object
) -> Trained:
    """Train a row, or continue its interrupted training. A finished run is not repeated.

    scene: a folder, or a scene that `clsplat train` gets instead of a folder's contents.
    words: further arguments of `clsplat train`.
    settings: `name=value,...`; if empty, the settings of --with. They take precedence over `usual`.
    usual: settings in addition to iterations, resolution and seed.
    """
    settings = settings or getattr(given, "settings", "")
    usual = {
        "iterations": given.iterations,
        "seed": given.seed,
        "resolution": getattr(given, "resolution", None),
    } | usual
    every = [*words_of(settings, **usual), *words]
    folder = scene if isinstance(scene, Path) else given.folder
    label = scene.name if isinstance(scene, Path) else f"{scene.name} {len(scene.train_views)}"
    digest = hashlib.blake2b(repr((label, every)).encode(), digest_size=4).hexdigest()
    run = given.folder / "runs" / f"{name.replace(', ', '-').replace(' ', '-').replace('/', '-')}-{digest}"
    if not (run / "eval.json").is_file():
        more = ["--resume"] if (run / "config.toml").is_file() else every
        services = None if isinstance(scene, Path) else Services(load_scene=lambda *_, **__: scene)
        call(["train", str(folder), "-o", str(run), "--no-report", *more], services)
    return Trained(run)


def call(words: list[str], services: Services | None = None) -> None:
    """Call `clsplat`. Raises SystemExit with its status if that is not 0."""
    with redirect_stdout(sys.stderr):  # standard output is for the table
        status = clsplat(words, services)
    if status:
        raise SystemExit(status)


def picture_of(renderer: Renderer, model: Gaussians, view: View) -> Image:
    """The picture of a model from a view."""
    return renderer.render(model, view.camera).image


def psnr_of(draw: Callable[[View], Image], views: Sequence[View], background: ArrayLike = (0, 0, 0)) -> float:
    """Mean PSNR of rendered views in dB."""
    mean = evaluate(draw, views, background, model=EvaluatedModel(None, 0, None))["mean"]
    return float(mean["psnr"])
