# SPDX-License-Identifier: Apache-2.0
"""Evaluation on held-out views: the scores in eval.json (PSNR, SSIM, LPIPS) and the renders in test/.

`load_scene` (clsplat/scenes/loading.py) decides which views are held out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import NotRequired, TypedDict

from clsplat.errors import ClsplatError, InputError
from clsplat.evaluation import metrics
from clsplat.files.names import identity
from clsplat.images.alpha import Image, composite
from clsplat.images.colour import displayed
from clsplat.images.writing import write_image
from clsplat.scenes.scene import View


class ViewScores(TypedDict):
    """Record of a held-out view in eval.json. Optional scores are present if they were measured.

    counted: fraction of the pixels that the view's mask keeps, if it has a mask.
    psnr_corrected: PSNR after an affine fit of the render's colours to the photograph's.
    psnr_aligned: PSNR after fitting the view's pose to the model.
    """

    name: str
    psnr: float
    ssim: float
    counted: NotRequired[float]
    psnr_corrected: NotRequired[float]
    psnr_aligned: NotRequired[float]
    lpips: NotRequired[float]


_AveragedScore = Literal["psnr", "psnr_corrected", "psnr_aligned", "ssim", "lpips"]
_AVERAGED_SCORES: tuple[_AveragedScore, ...] = ("psnr", "psnr_corrected", "psnr_aligned", "ssim", "lpips")


class Evaluation(TypedDict):
    """Content of eval.json.

    step, gaussians, seconds: training step, number of Gaussians and training time of the model; None if unknown.
    mean: mean of each score over the views, keyed by the score's name; empty without views.
    lpips_missing: reason why LPIPS was not measured.
    """

    step: int | None
    gaussians: int
    seconds: float | None
    mean: dict[str, float]
    views: list[ViewScores]
    lpips_missing: NotRequired[str]


@dataclass(frozen=True)
class EvaluatedModel:
    """Step, number of Gaussians and training time in seconds of the evaluated model. None for an unknown value."""

    step: int | None
    gaussians: int
    seconds: float | None


def evaluate(
    render: Callable[[View], Image],
    views: Sequence[View],
    background: ArrayLike,
    save_dir: Path | None = None,
    *,
    model: EvaluatedModel,
    space: str = "sRGB",
    corrected: bool = False,
    aligned: Callable[[View], Image] | None = None,
) -> Evaluation:
    """Measure the render of every view against its photograph. Returns the content of eval.json.

    render: function that returns a view's float image (H, W, 3) over `background` (3,), at the size of `view.load()`,
        with the view's appearance (`runs/appearance.py`: `held_out_looks`).
    save_dir: folder for the renders, which are written as sRGB PNG with the views' names.
    model: description of the model, which is copied to the result.
    space: colour space of renders and photographs. They are compared in this space.
    corrected: also measure PSNR after an affine fit of colours.
    aligned: function that fits a view's pose to the model, and returns the image from this pose. The PSNR of this
        image is also measured.

    Scores leave out the pixels that a mask excludes. Raises ClsplatError if a render is not finite. Raises InputError,
    with the view's name, for a view that is too small for SSIM. Also raises InputError for an unknown colour space.
    """
    records: list[ViewScores] = []
    names = picture_names([view.name for view in views])
    for view, name in zip(views, names, strict=True):
        pixels, counts = photograph_of(view)
        truth, image = composite(pixels, background), np.asarray(render(view))
        if not np.isfinite(image).all():
            raise ClsplatError(f"the render of {view.name} has values that are not finite")
        records.append(_scores(view, image, truth, counts, corrected=corrected, aligned=aligned))
        if save_dir is not None:
            path = save_dir / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write_image(path, displayed(image, space))
    keys = [key for key in _AVERAGED_SCORES if records and key in records[0]]
    mean: dict[str, float] = {key: float(np.mean([record[key] for record in records])) for key in keys}
    result: Evaluation = {
        "step": model.step,
        "gaussians": model.gaussians,
        "seconds": model.seconds,
        "mean": mean,
        "views": records,
    }
    if records and (reason := metrics.lpips_missing()):
        result["lpips_missing"] = reason
    return result


def _scores(
    view: View,
    image: Image,
    truth: Image,
    counts: NDArray[np.bool_] | None,
    *,
    corrected: bool,
    aligned: Callable[[View], Image] | None,
) -> ViewScores:
    """Measure one view. Returns the view's record in eval.json.

    image, truth: the view's render, and the photograph over the same background.
    counts: mask (H, W), True for pixels that are compared; None for all.
    corrected, aligned: as for `evaluate`.
    """
    try:
        record: ViewScores = {
            "name": view.name,
            "psnr": metrics.psnr(image, truth, counts),
            "ssim": metrics.ssim(image, truth, counts),
        }
        if counts is not None:
            record["counted"] = float(counts.mean())
    except (InputError, ValueError) as error:
        raise InputError(f"{view.name}: {error}") from None
    if corrected:
        record["psnr_corrected"] = metrics.psnr_corrected(image, truth, counts)
    if aligned is not None:
        record["psnr_aligned"] = metrics.psnr(np.asarray(aligned(view)), truth, counts)
    seen = image if counts is None else np.where(counts[:, :, None], image, 0)
    if (perceptual := metrics.lpips(seen, truth)) is not None:
        record["lpips"] = perceptual
    return record


def photograph_of(view: View) -> tuple[Image, NDArray[np.bool_] | None]:
    """Load a view's pixels, and its mask (H, W), True for pixels to compare. Without a mask the second result is None.

    Raises InputError if the mask excludes every pixel.
    """
    image = view.load_masked()
    if image.shape[2] < 5:
        return image, None
    counts = image[:, :, 4] > 0
    if not counts.any():
        raise InputError(f"{view.name}: its mask excludes all pixels; hold out another view")
    return image[:, :, :4] * counts[:, :, None], counts


def picture_names(names: Sequence[str]) -> list[str]:
    """Choose the names of the views' PNG files, relative to their folder and with the views' sub-folders.

    ".png" replaces the view's extension. If two names would then collide, also on a file system that ignores case,
    ".png" is appended instead.
    """
    stems = [str(PurePosixPath(name).with_suffix("")) for name in names]
    # case is ignored on every system, so that the names are the same everywhere
    keys = [identity(PurePosixPath(stem), ignores_case=True) for stem in stems]
    uses = Counter(keys)
    return [(stem if uses[key] == 1 else name) + ".png" for stem, key, name in zip(stems, keys, names, strict=True)]
