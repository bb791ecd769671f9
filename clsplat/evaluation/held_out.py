# SPDX-License-Identifier: Apache-2.0
"""Held-out views against their photographs: the numbers of eval.json and the pictures of test/."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.errors import ClsplatError, InputError
from clsplat.evaluation import metrics
from clsplat.files import identity
from clsplat.images.alpha import Image, composite
from clsplat.images.colour import displayed
from clsplat.images.writing import write_image
from clsplat.scenes.scene import View


def evaluate(
    render: Callable[[View], Image],
    views: Sequence[View],
    background: ArrayLike,
    save_dir: Path | None = None,
    *,
    step: int | None,
    gaussians: int,
    seconds: float | None,
    space: str = "sRGB",
    corrected: bool = False,
    aligned: Callable[[View], Image] | None = None,
) -> dict[str, Any]:
    """Measure every view; returns the content of eval.json.

    render: gives a view's image (H, W, 3), float, over `background` (3,), at the size of `view.load()`; save_dir: the
    renders go there as PNG in sRGB, under the view's name. space: the colour space of renders and photographs, in
    which they are measured. corrected: measure PSNR after an affine fit of colours as well; aligned: renders with the
    view's pose where the model fits best, whose PSNR is measured as well. step, gaussians, seconds
    are passed through. Without views the mean is empty. Pixels that a mask leaves out count in no score
    (`metrics.ssim`), and "counted" is the share of those that do. lpips_missing says why there is no LPIPS, where there
    is none. Raises ClsplatError where a render is not finite, InputError naming a view that is too small, or a space
    that is not known.
    """
    records: list[dict[str, Any]] = []
    names = picture_names([view.name for view in views])
    for view, name in zip(views, names, strict=True):
        pixels, counts = photograph_of(view)
        truth, image = composite(pixels, background), np.asarray(render(view))
        if not np.isfinite(image).all():
            raise ClsplatError(f"the render of {view.name} has values that are not finite")
        try:
            record: dict[str, Any] = {
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
        records.append(record)
        if save_dir is not None:
            path = save_dir / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write_image(path, displayed(image, space))
    keys = [key for key in ("psnr", "psnr_corrected", "psnr_aligned", "ssim", "lpips") if records and key in records[0]]
    mean = {key: float(np.mean([record[key] for record in records])) for key in keys}
    result: dict[str, Any] = {"step": step, "gaussians": gaussians, "seconds": seconds, "mean": mean, "views": records}
    if records and (reason := metrics.lpips_missing()):
        result["lpips_missing"] = reason
    return result


def photograph_of(view: View) -> tuple[Image, NDArray[np.bool_] | None]:
    """A view's pixels, and those of them that count, (H, W), where it has a mask. Raises InputError where none does."""
    image = view.load_masked()
    if image.shape[2] < 5:
        return image, None
    counts = image[:, :, 4] > 0
    if not counts.any():
        raise InputError(f"{view.name}: its mask leaves nothing to measure; hold out another view")
    return image[:, :, :4] * counts[:, :, None], counts


def picture_names(names: Sequence[str]) -> list[str]:
    """Relative names of PNG files for views, in their sub-folders. Their extension takes the place of the view's, and
    is added where two names would be one, also on a file system that ignores case."""
    stems = [str(PurePosixPath(name).with_suffix("")) for name in names]
    keys = [identity(PurePosixPath(stem), ignores_case=True) for stem in stems]  # the same names on every system
    uses = Counter(keys)
    return [(stem if uses[key] == 1 else name) + ".png" for stem, key, name in zip(stems, keys, names, strict=True)]
