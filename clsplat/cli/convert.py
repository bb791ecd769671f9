# SPDX-License-Identifier: Apache-2.0
"""`clsplat convert` and `clsplat info`: model files to others, edited on the way, and what they hold."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from math import inf, isclose, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from clsplat.arrays import Float32, Float64
from clsplat.cli.options import Convert, Info
from clsplat.config.memory import parse_bytes
from clsplat.config.verbs import TEST_EVERY
from clsplat.errors import InputError
from clsplat.files import check_new, is_file, read_document
from clsplat.gaussians import MAX_SH_DEGREE, Gaussians
from clsplat.images import colour
from clsplat.models import difference, edit
from clsplat.models.formats import Format, format_of, format_of_name, load, model_path, save
from clsplat.models.info import model_info, size, text
from clsplat.progress import StageProgress
from clsplat.runs.run import is_run, model_file

if TYPE_CHECKING:
    from clsplat.rendering.renderer import Renderer
    from clsplat.scenes.scene import View

QUICK = 2.0
"""Seconds that writing a file may take without a word."""
NEAR_SLACK = 0.05
"""A part of a near plane: where a file has none it follows from positions, which a format may have rounded."""
MAX_MATRIX = 1 << 16
"""Bytes of a file with a matrix."""


def info(verb: Info) -> int:
    """Print it."""
    found = model_info(_file(verb.model))
    print(json.dumps(found, indent=2) if verb.json else text(found))
    return 0


def convert(verb: Convert) -> int:
    """Read, edit, write, read back. What is wrong with the call is found before anything is written."""
    source = _file(verb.source)
    check(verb)
    matrix = similarity(verb)
    written_by = format_of_name(verb.target, writable=True)
    check_new(verb.target, overwrite=verb.overwrite, sources=[source, *map(_file, verb.merge)])
    for companion in written_by.side_files(verb.target):
        check_new(companion, overwrite=verb.overwrite)
    original, space = load(source), colour.recorded_space(source)
    edited = original
    if verb.merge:
        others = [(path, load(path)) for path in map(_file, verb.merge)]
        for path, other in others:
            _tell_mismatch(path, other, source, original)
        edited = edit.merge([original, *(other for _, other in others)])
    edited = _thinned(verb, edited)
    if matrix is not None:
        edited = edit.transform(edited, matrix)
    if verb.drop_sh is not None:
        edited = edit.drop_sh(edited, verb.drop_sh)
    comments = () if space == colour.SRGB else (colour.comment(space),)
    save(verb.target, edited, comments=comments, progress=StageProgress(after=QUICK))
    if space != colour.recorded_space(verb.target):
        _warn(f"{verb.target}: {written_by.name} has no place for the colour space, which is {space}")
    read = load(verb.target)
    if not isclose(read.near, edited.near, rel_tol=NEAR_SLACK):
        _warn(
            f"{verb.target}: {written_by.name} has no place for the near plane, which is {edited.near:.4g}; readers "
            f"will take {read.near:.4g}"
        )
    written = edit.take(edited, written_by.order(edited)) if written_by.order else edited
    found = difference.errors(written, read)
    result: dict[str, Any] = {
        "source": _described(source, format_of(source), original),
        "target": _described(verb.target, written_by, read),
        "errors": found,
    }
    if verb.scene is not None:
        result["scene"] = _measure(verb, original, read, matrix)
    if verb.json:
        print(json.dumps(result, indent=2))
        return 0
    for name in ("source", "target"):
        each = result[name]
        print(f"{each['path']}: {each['format']}, {each['gaussians']:,} Gaussians of SH degree {each['sh_degree']}, "
              f"{each['bytes']:,} bytes")  # fmt: skip
    print(difference.table(found))
    if verb.scene is not None:
        scene = result["scene"]
        print(f"{len(scene['views'])} views  PSNR {scene['before']:.2f} dB before, {scene['after']:.2f} after; the "
              f"renders against each other {scene['between']:.2f}, at least {scene['least_between']:.2f}")  # fmt: skip
    return 0


def _tell_mismatch(path: Path, other: Gaussians, source: Path, first: Gaussians) -> None:
    """A warning where a model that is merged is in another colour space, or its place is far from the first's."""
    space, wanted = colour.recorded_space(path), colour.recorded_space(source)
    if space != wanted:
        _warn(f"--merge {path}: its colours are of {space}, those of {source} of {wanted}, as which all will count")
    distance = float(np.linalg.norm(other.origin - first.origin))
    if len(other) and distance > edit.FAR * float(other.means.std(axis=0).max()):
        step = float(np.spacing(np.float32(distance)))
        _warn(
            f"--merge {path}: counts from a place {distance:.6g} world units from that of {source}; its positions are "
            f"rounded to {step:.2g}. Is only one of the two georeferenced?"
        )


def check(verb: Convert) -> None:
    """Raise InputError for a number out of its range, and for flags that lack their companion."""
    ranges = {
        "scale": (0.0, inf, "a number over 0"),
        "prune_opacity": (-inf, 1.0, "0 to 1"),
        "prune_contribution": (0.0, inf, "pixels, a number over 0"),
    }
    for name, (low, high, expected) in ranges.items():
        value = getattr(verb, name)
        if value is not None and not (low < value <= high and isfinite(value) and value >= 0):
            raise InputError(f"--{name.replace('_', '-')} {value}: expected {expected}")
    if verb.drop_sh is not None and not 0 <= verb.drop_sh <= MAX_SH_DEGREE:
        raise InputError(f"--drop-sh {verb.drop_sh}: expected 0 to {MAX_SH_DEGREE}")
    if (verb.prune_contribution is None) != (verb.cameras is None):
        raise InputError("--prune-contribution and --cameras go together: contributions are to these cameras")
    of_scene = {"test_every": TEST_EVERY, "resolution": 0, "background": "black"}
    given = [f"--{name.replace('_', '-')}" for name, usual in of_scene.items() if getattr(verb, name) != usual]
    if verb.scene is None and given:
        raise InputError(f"{', '.join(given)}: of measuring on a scene, expected --scene with it")
    if verb.test_every < 0 or verb.resolution < 0:
        raise InputError(f"--test-every {verb.test_every} --resolution {verb.resolution}: expected at least 0")


def similarity(verb: Convert) -> Float64 | None:
    """--transform, then --scale, as one (4, 4); None without them. Raises InputError."""
    if verb.transform is None and verb.scale is None:
        return None
    matrix = np.eye(4) if verb.transform is None else _matrix(verb.transform)
    try:
        edit.decompose(matrix)
    except InputError as error:
        raise InputError(f"--transform {verb.transform}: {error}") from None
    return matrix if verb.scale is None else edit.scaling(verb.scale) @ matrix


def _matrix(given: str) -> Float64:
    words = given
    if is_file(given):
        words = read_document(Path(given), "a text file of 16 numbers", MAX_MATRIX)
    return np.array(numbers("transform", words, 16)).reshape(4, 4)


def numbers(flag: str, given: str, count: int) -> list[float]:
    """Finite numbers with commas or blanks between them, brackets passed over. Raises InputError."""
    words = given.translate(str.maketrans("[],;", "    ")).split()
    try:
        found = [float(word) for word in words]
    except ValueError:
        found = []
    if len(found) != count or not all(map(isfinite, found)):
        raise InputError(f"--{flag} {given[:80]}: expected {count} numbers with commas")
    return found


def _file(path: Path) -> Path:
    """The model's file, of a run's folder or of a format that is one."""
    return model_file(path) if is_run(path) else model_path(path)


def _thinned(verb: Convert, gaussians: Gaussians) -> Gaussians:
    """Cropped and pruned. Raises InputError where nothing is left."""

    def keep(flag: str, rows: Any) -> None:
        nonlocal gaussians
        if not rows.any():
            raise InputError(f"--{flag}: none of the {len(gaussians):,} Gaussians is left")
        gaussians = gaussians if rows.all() else edit.take(gaussians, rows)

    if verb.crop is not None:
        corners = numbers("crop", verb.crop, 6)
        if any(low > high for low, high in zip(corners[:3], corners[3:], strict=True)):
            raise InputError(f"--crop {verb.crop}: expected X0 <= X1, Y0 <= Y1 and Z0 <= Z1")
        keep("crop", edit.in_box(gaussians, corners[:3], corners[3:]))
    if verb.crop_sphere is not None:
        *centre, radius = numbers("crop-sphere", verb.crop_sphere, 4)
        keep("crop-sphere", edit.in_sphere(gaussians, centre, radius))
    if verb.prune_opacity is not None:
        keep("prune-opacity", edit.opaque(gaussians, verb.prune_opacity))
    if verb.prune_contribution is not None:
        keep("prune-contribution", _contributions(verb, gaussians) >= verb.prune_contribution)
    return gaussians


def _contributions(verb: Convert, gaussians: Gaussians) -> Float32:
    from clsplat.device.context import open_device
    from clsplat.rendering.contributions import largest_contributions
    from clsplat.selftest.trust import require
    from clsplat.shots import choose_shot

    assert verb.cameras is not None
    shot = choose_shot(verb.cameras)
    for warning in shot.warnings:
        _warn(warning)
    device = require(open_device(verb.device, parse_bytes(verb.max_device_mem)))
    return largest_contributions(gaussians, shot.cameras, device)


def _described(path: Path, form: Format, gaussians: Gaussians) -> dict[str, Any]:
    size_of = {"path": str(path), "format": form.name, "bytes": size(path, form)}
    return size_of | {"gaussians": len(gaussians), "sh_degree": gaussians.sh_degree}


def _measure(verb: Convert, original: Gaussians, read: Gaussians, matrix: Float64 | None) -> dict[str, Any]:
    """PSNR in dB of the model as it was read and of the one that was written, which is seen by cameras that moved
    along, against the photographs and against each other."""
    from clsplat.device.context import open_device
    from clsplat.rendering.renderer import Renderer
    from clsplat.selftest.result import FORWARD
    from clsplat.selftest.trust import require

    device = open_device(verb.device, parse_bytes(verb.max_device_mem))
    views = _views(verb)
    renderer = Renderer(require(device, FORWARD))
    before = [_render(renderer, original, verb, view, None) for view in views]
    after = [_render(renderer, read, verb, view, matrix) for view in views]
    return compared(verb.background, views, before, after)


def compared(background: str, views: Sequence[View], before: list[Float32], after: list[Float32]) -> dict[str, Any]:
    """Renders (H, W, 3) of the views: PSNR in dB of each, and the means."""
    from clsplat.evaluation.metrics import psnr
    from clsplat.images.alpha import background_colour, composite

    records: list[dict[str, Any]] = []
    for view, a, b in zip(views, before, after, strict=True):
        truth = composite(view.load(), background_colour(background))
        record = {"before": psnr(a, truth), "after": psnr(b, truth), "between": psnr(a, b)}
        records.append({"name": view.name, **record})
    mean = {key: float(np.mean([record[key] for record in records])) for key in ("before", "after", "between")}
    return {**mean, "least_between": min(record["between"] for record in records), "views": records}


def _views(verb: Convert) -> list[View]:
    from clsplat.scenes.scene import load_scene

    assert verb.scene is not None
    scene = load_scene(verb.scene, resolution=verb.resolution, test_every=verb.test_every, progress=StageProgress())
    for warning in scene.warnings:
        _warn(warning)
    return scene.test_views or scene.views


def _render(renderer: Renderer, gaussians: Gaussians, verb: Convert, view: View, matrix: Float64 | None) -> Float32:
    from clsplat.images.alpha import background_colour

    camera = view.camera if matrix is None else edit.transform_camera(view.camera, matrix)
    return renderer.render(gaussians, camera, background_colour(verb.background)).image


def _warn(line: str) -> None:
    print(f"clsplat: warning: {line}", file=sys.stderr)
