# SPDX-License-Identifier: Apache-2.0
"""The experiment of border colours: steps of colour between blocks, in towns whose exposures change."""

from __future__ import annotations

import shutil
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import OpenImageIO as oiio
from quality.blocks import BAND_METRES, EXTRA_STEPS, Border, borders_of, city_of, ground_of, models_of, town_of
from quality.trainings import Rows, Trained, trained

from clsplat.arrays import Float32, Float64
from clsplat.blocks import block_training
from clsplat.blocks.block_settings import block_settings
from clsplat.blocks.plan import read_plan
from clsplat.config.training import TrainConfig
from clsplat.device.selection import open_device
from clsplat.gaussians import Gaussians
from clsplat.images.colour import linear_to_srgb, srgb_to_linear
from clsplat.optimisation.trained_region import TrainedRegion
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.loading import load_scene
from clsplat.training.start import Start

STOPS_OF_BLOCKS = (0.8, -0.5, -0.7, 0.4)
"""Exposures of the town's blocks, in stops, in turn."""
DARKEST = 0.01
"""Number that is added to colours before their ratio is taken, as in dark places the ratio tells little."""


@contextmanager
def own_appearance() -> Iterator[None]:
    """Context in which blocks and finish learn appearances of their own, in place of the coarse model's."""

    def start(model: Gaussians, region: TrainedRegion | None, _learnt: Path | None) -> Start:
        return Start(model, region)

    with patch.object(block_training, "Start", start):
        yield


@contextmanager
def frozen_appearance() -> Iterator[None]:
    """Context in which blocks keep the coarse model's appearance."""

    def frozen(*given: Any) -> TrainConfig:
        return replace(block_settings(*given), appearance_rate=0.0)

    with patch.object(block_training, "block_settings", frozen):
        yield


APPEARANCES: dict[str, Callable[[], AbstractContextManager[None]]] = {
    "begun from the coarse model's, trained": nullcontext,
    "the coarse model's, frozen": frozen_appearance,
    "learnt by each block": own_appearance,
}
"""Contexts in which blocks are trained, keyed by their name in the table."""


def exposed_town(given: Namespace) -> Path:
    """Write the town with one exposure for each of its blocks, or take the one that is there."""
    folder: Path = given.folder / "town-exposed"
    if not folder.exists():
        partial = given.folder / "town-exposed.partial"
        shutil.rmtree(partial, ignore_errors=True)
        shutil.copytree(town_of(given), partial)
        for place, block in enumerate(sorted((partial / "images").iterdir())):
            for path in sorted(block.iterdir()):
                _expose(path, 2.0 ** STOPS_OF_BLOCKS[place % len(STOPS_OF_BLOCKS)])
        partial.rename(folder)
    return folder


def _expose(path: Path, factor: float) -> None:
    """Multiply the light of an sRGB photograph, in place."""
    buffer = oiio.ImageBuf(str(path))
    light = srgb_to_linear(np.asarray(buffer.get_pixels(oiio.FLOAT), np.float32)) * np.float32(factor)
    target = oiio.ImageBuf(buffer.spec())
    target.set_pixels(target.roi, linear_to_srgb(np.minimum(light, 1)))
    target.specmod().attribute("Compression", "jpeg:97")
    if not target.write(str(path)):
        raise OSError(f"{path}: {target.geterror()}")


def colour_steps(
    renders: Sequence[Float32], judge: Sequence[Float32], ground: Sequence[Float64], borders: Sequence[Border]
) -> tuple[Float64, Float64]:
    """Steps of colour across borders, in levels of 1/255: two arrays (borders, 3) of the lower side less the upper.

    judge: the pictures that the renders are compared with. Of the pixels within BAND_METRES of a border, a gain for
        each channel is taken out.
    The first step is the difference of the mean errors on the border's sides, the second that of the medians of the
    log ratios, times the mean colour. A few badly reconstructed surfaces can move the first by a level.
    """
    means, medians = [], []
    for border in borders:
        parts = []
        for image, wanted, places in zip(renders, judge, ground, strict=True):
            distance = border.distances(places)
            near = np.abs(distance) < BAND_METRES
            parts.append(np.column_stack([distance[near], image[near], wanted[near]]))
        rows = np.concatenate(parts)
        low, image, wanted = rows[:, 0] < 0, rows[:, 1:4], rows[:, 4:7]
        gain = (image * wanted).sum(axis=0) / np.square(image).sum(axis=0)
        errors, logs = image * gain - wanted, np.log((image + DARKEST) / (wanted + DARKEST))
        means.append(errors[low].mean(axis=0) - errors[~low].mean(axis=0))
        medians.append(wanted.mean() * (np.median(logs[low], axis=0) - np.median(logs[~low], axis=0)))
    return 255 * np.array(means), 255 * np.array(medians)


def border_colours(given: Namespace) -> Rows:
    """Steps of colour across the borders of blocks, of trainings with several seeds.

    The town's exposures drift from flight to flight (--exposure), or each of its blocks has one (--exposed-blocks). The
    steps are those between the model and the whole's of the same seed, whose own errors then cancel, and those between
    the model and the photographs as they were before their exposures were changed. *all* is the step of the mean over
    the trainings, *one* the largest of a single training. Each training plans anew, which moves its borders by some
    metres; they are taken in the plan's order. Wholes of two seeds, compared like this, show what chance does.
    """
    renderer, clean = Renderer(open_device()), load_scene(town_of(given), resolution=given.resolution)
    town = exposed_town(given) if given.exposed_blocks else town_of(given, given.exposure)
    photographs = [view.load()[:, :, :3] for view in clean.views]
    growth = f"density.growth=budget,density.max-gaussians={given.gaussians}"
    settings = f"schedule=short,sky={given.sky},appearance=exposure,{growth},{given.settings}".rstrip(",")
    steps: dict[tuple[str, str], list[Float64]] = {}
    scores: dict[tuple[str, str], list[float]] = {}
    earlier: list[Float32] | None = None

    def drawn(model: Gaussians) -> list[Float32]:
        return [renderer.render(model, view.camera).image for view in clean.views]

    for seed in given.seeds:
        given.seed = seed
        cities: dict[str, Path] = {}
        for kind, context in APPEARANCES.items():
            first = next(iter(cities.values()), None)
            with context():
                cities[kind] = city_of(given, town, f"{town.name} {kind} {seed}", settings, planned=first)
        city = next(iter(cities.values()))
        as_many = f"{settings},density.max-gaussians={len(models_of(city)['finished'])}"
        iterations = round(EXTRA_STEPS * given.iterations)
        whole, plan = trained(given, "whole", town, settings=as_many, iterations=iterations), read_plan(city)
        borders, ground = borders_of(plan), ground_of(renderer, whole.model, clean.views, plan)
        of_whole = drawn(whole.model)
        steps.setdefault(("", "whole"), []).append(
            np.stack([np.zeros((2, len(borders), 3)), colour_steps(of_whole, photographs, ground, borders)])
        )
        scores.setdefault(("", "whole"), []).append(_psnr(whole))
        if earlier is not None:
            found = [colour_steps(earlier, judge, ground, borders) for judge in (of_whole, photographs)]
            steps.setdefault(("", "whole of the seed before"), []).append(np.array(found))
        earlier = of_whole
        for kind, city in cities.items():
            for name, model in models_of(city).items():
                images = drawn(model)
                found = [colour_steps(images, judge, ground, borders) for judge in (of_whole, photographs)]
                steps.setdefault((kind, name), []).append(np.array(found))
            scores.setdefault((kind, "finished"), []).append(_psnr(Trained(city)))
    yield (
        *("appearance of blocks", "model", "colour-corrected PSNR, dB"),
        *(f"{of}, {how}" for of in ("whole: mean", "whole: median", "photographs: mean") for how in ("all", "one")),
    )
    for key, values in steps.items():
        every = np.array(values)  # trainings, judges, measures, borders, channels
        cells = []
        for judge, measure in ((0, 0), (0, 1), (1, 0)):
            each = every[:, judge, measure]
            cells += [np.abs(each.mean(axis=0)).mean(axis=1), np.abs(each).mean(axis=2).max(axis=0)]
        psnr = f"{np.mean(scores[key]):.2f}" if key in scores else ""
        yield *key, psnr, *(", ".join(f"{step:.2f}" for step in cell) if cell.any() else "" for cell in cells)
    return 0


def _psnr(run: Trained) -> float:
    return float(run.last["mean"]["psnr_corrected"])
