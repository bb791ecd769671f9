# SPDX-License-Identifier: Apache-2.0
"""Statistics of a model file for `clsplat info`. The file may have non-finite values. A PLY is read in blocks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import TypedDict

from clsplat.arrays import Float32
from clsplat.camera import DEFAULT_NEAR_PLANE
from clsplat.errors import warn
from clsplat.files.documents import is_file
from clsplat.gaussians import Gaussians
from clsplat.models.codec import repair
from clsplat.models.codec import values as packing
from clsplat.models.formats import Format, resolve

INFO_PERCENTILES = (0, 1, 50, 99, 100)
MAX_FLOAT64_LOG = 709.0
"""Largest log scale whose scale fits float64."""


class Bounds(TypedDict):
    """Bounding box of the means in world units, the length of its diagonal, and percentiles of each coordinate."""

    min: list[float]
    max: list[float]
    extent: float
    p1: list[float]
    p99: list[float]


class ValueStatistics(TypedDict, total=False):
    """Statistics of the Gaussians with finite values; empty if there are none.

    scale, opacity: percentiles, such as "p50", and their values.
    """

    bounds: Bounds
    scale: dict[str, float]
    opacity: dict[str, float]


class ModelStatistics(ValueStatistics):
    """Statistics of all Gaussians.

    not_finite, zero_quaternions: numbers of Gaussians with non-finite values, and with a quaternion of 0.
    sh_degree_used: the highest SH band with a coefficient other than 0.
    """

    gaussians: int
    not_finite: int
    zero_quaternions: int
    sh_degree: int
    sh_degree_used: int
    origin: list[float]


def model_info(path: Path) -> dict[str, Any]:
    """Statistics that `clsplat info --json` prints. Raises InputError if no format reads the file."""
    path, form = resolve(path)
    result: dict[str, Any] = {"path": str(path), "format": form.name, "bytes": size(path, form)}
    if form.blocks:
        blocks = form.blocks(path)
    else:
        model = form.read(path)
        blocks = iter([replace(model, means=packing.world_means(model).astype(np.float32))])
    result |= {"loses": form.loses} | form.describe(path)
    result |= _summary(blocks, path)
    result["colorspace"] = form.space(path)
    result["loses"] = result.pop("loses")  # moves "loses" to the end
    return result


def size(path: Path, form: Format) -> int:
    """Size in bytes of all files of a model. path: its main file."""
    return sum(file.stat().st_size for file in (path, *form.side_files(path)) if is_file(file))


def _summary(blocks: Iterator[Gaussians], path: Path) -> ModelStatistics:
    """Statistics over all blocks. Warns about values that look wrongly encoded, as `load` would.

    Means, log scales and opacity logits stay in memory for the percentiles: 28 bytes per Gaussian.
    """
    parts: list[list[Float32]] = []
    not_finite = unturned = degree = used = 0
    for block in blocks:
        degree, origin = block.sh_degree, block.origin
        repair.replace_infinities(block)
        good = repair.finite_rows(block)
        not_finite += int((~good).sum())
        unturned += int((good & repair.without_rotation(block)).sum())
        used = max([used, *(band for band in range(1, degree + 1) if block.sh[:, band**2 : (band + 1) ** 2].any())])
        parts.append([array[good] for array in (block.means, block.log_scales, block.opacity_logits)])
    m, s, o = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    finite: ValueStatistics = {}
    if len(m):
        for warning in repair.encoding_warnings(o, s):
            warn(f"{path}: {warning}")
        finite = {
            "bounds": _bounds(m),
            "scale": _percentiles(np.exp(np.minimum(s.astype(np.float64), MAX_FLOAT64_LOG))),
            "opacity": _percentiles(packing.opacities(o)),
        }
    return {
        "gaussians": len(m) + not_finite,
        "not_finite": not_finite,
        "zero_quaternions": unturned,
        "sh_degree": degree,
        "sh_degree_used": used,
        **finite,
        "origin": origin.tolist(),
    }


def _bounds(means: Float32) -> Bounds:
    low, high = means.min(axis=0).astype(np.float64), means.max(axis=0).astype(np.float64)
    p1, p99 = np.percentile(means, (1, 99), axis=0)
    return {
        "min": low.tolist(),
        "max": high.tolist(),
        "extent": float(np.linalg.norm(high - low)),
        "p1": p1.tolist(),
        "p99": p99.tolist(),
    }


def _percentiles(values: NDArray[Any]) -> dict[str, float]:
    results = np.percentile(values, INFO_PERCENTILES)
    return {f"p{percent}": float(value) for percent, value in zip(INFO_PERCENTILES, results, strict=True)}


def text(info: dict[str, Any], place: str | None = None) -> str:
    """The result of `model_info` as text, with a line for each statistic.

    place: description of the model's place on the earth; None if it is unknown.
    """

    def numbers(values: list[float]) -> str:
        return " ".join(f"{value:.6g}" for value in values)

    details = [f"{key} {info[key]}" for key in ("version", "encoding", "level") if key in info]
    count = info["gaussians"]
    lines = [
        ("format", ", ".join([info["format"], *details])),
        ("bytes", f"{info['bytes']:,}, {info['bytes'] / max(count, 1):.1f} a Gaussian"),
    ]
    odd = f", {info['not_finite']:,} of them not finite and left out" if info["not_finite"] else ""
    odd += f", {info['zero_quaternions']:,} with a quaternion of 0, drawn unrotated" if info["zero_quaternions"] else ""
    lines.append(("Gaussians", f"{count:,}{odd}"))
    used = info["sh_degree_used"]
    only = "" if used == info["sh_degree"] else f", zero beyond {used}"
    lines.append(("SH degree", f"{info['sh_degree']}{only}"))
    if "bounds" in info:
        bounds = info["bounds"]
        lines.append(("bounds", f"{numbers(bounds['min'])} to {numbers(bounds['max'])}, extent {bounds['extent']:.6g}"))
        lines.append(("98 % within", f"{numbers(bounds['p1'])} to {numbers(bounds['p99'])}"))
        percentiles = {
            name: [f"{key} {value:.4g}" for key, value in info[name].items()] for name in ("scale", "opacity")
        }
        lines += [(name, ", ".join(values)) for name, values in percentiles.items()]
    if any(info["origin"]):
        lines.append(("origin", " ".join(map(repr, info["origin"]))))
    if info.get("near", DEFAULT_NEAR_PLANE) != DEFAULT_NEAR_PLANE:
        lines.append(("near plane", f"{info['near']:.6g}"))
    if info.get("antialiased"):
        lines.append(("antialiased", "yes: to be drawn with Mip-Splatting's low-pass filter"))
    if info.get("by_rays"):
        lines.append(("perspective", "drawn along rays, like a fisheye; other programs would show a haze"))
    if place is not None:
        lines.append(("on the earth", place))
    lines.append(("colour space", info["colorspace"]))
    lines += [("comment", line) for line in info.get("comments", [])]
    if info.get("ignored"):
        lines.append(("ignored", " ".join(info["ignored"])))
    if info["loses"]:
        lines.append(("loses", info["loses"]))
    width = max(len(name) for name, _ in lines)
    return "\n".join(f"{name.ljust(width)}  {value}" for name, value in lines)
