# SPDX-License-Identifier: Apache-2.0
"""The experiment of survey formats: one scene as COLMAP, OpenSfM, Metashape and RealityScan write it."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import numpy as np
from quality.trainings import Rows, trained
from ring import Pose
from survey_files import Optics, chunk_at, write_metashape, write_opensfm, write_xmp

from clsplat.arrays import Float64
from clsplat.errors import InputError
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene

SURVEY_KINDS = ("opensfm", "metashape", "realityscan")


def survey_formats(given: Namespace) -> Rows:
    """Train one COLMAP scene from each survey format, and compare its cameras and held-out PSNR with COLMAP's.

    The scene has pinhole lenses with the principal point in the middle, as a town of `clsplat demo --town` with
    --town-origin has. Metashape's and RealityScan's files have no points, and get COLMAP's as a PLY of doubles.
    """
    yield "format", "largest difference of positions", "of focal lengths, px", "PSNR, dB", "less than COLMAP's"
    (source,) = given.scenes
    scene = load_scene(source, resolution=given.resolution)
    first = trained(given, f"{source.name} colmap", source).last["mean"]["psnr"]
    yield "COLMAP", "", "", f"{first:.3f}", ""
    worst = 0.0
    for kind in SURVEY_KINDS:
        folder = given.folder / "scenes" / kind / source.name
        _write(kind, scene, folder)
        other = load_scene(folder, resolution=given.resolution)
        pairs = list(zip(scene.views, other.views, strict=True))
        far = max(float(np.abs(one.camera.position - two.camera.position).max()) for one, two in pairs)
        focal = max(abs(one.camera.fx - two.camera.fx) for one, two in pairs)
        psnr = trained(given, f"{source.name} {kind}", folder).last["mean"]["psnr"]
        worst = max(worst, abs(first - psnr))
        yield kind, f"{far:.1e}", f"{focal:.1e}", f"{psnr:.3f}", f"{first - psnr:.3f}"
    return int(worst > given.bound)


def _write(kind: str, scene: Scene, folder: Path) -> None:
    """Write a scene with links to its pictures, if the folder does not exist yet."""
    if folder.exists():
        return
    lenses = [view.lens for view in scene.views]
    if any(not lens.is_pinhole or lens.centre != (lens.width / 2, lens.height / 2) for lens in lenses):
        raise InputError(f"{scene.name}: has other lenses than pinholes with the principal point in the middle")
    optics = [Optics(lens.width, lens.height, lens.focal) for lens in lenses]
    posed: list[Pose] = [(view.camera.rotation, view.camera.translation) for view in scene.views]
    names = [view.name for view in scene.views]
    pictures = folder if kind == "realityscan" else folder / "images"
    for view in scene.views:
        (pictures / view.name).parent.mkdir(parents=True, exist_ok=True)
        (pictures / view.name).symlink_to(view.path.absolute())
    levels = np.rint(255 * scene.point_colors).astype(np.uint8)
    if kind == "opensfm":
        write_opensfm(folder, posed, names, optics=optics, cloud=(scene.points, levels))
        return
    if kind == "metashape":
        middle = np.median([view.camera.position for view in scene.views], axis=0)
        write_metashape(folder, posed, names, world_from_chunk=chunk_at(middle), optics=optics)
    else:
        write_xmp(folder, posed, names, optics=optics)
    _write_points(folder / "points.ply", scene.points, levels)


def _write_points(path: Path, points: Float64, levels: np.ndarray) -> None:
    kinds = [*(f"double {axis}" for axis in "xyz"), *(f"uchar {name}" for name in ("red", "green", "blue"))]
    head = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *(f"property {kind}" for kind in kinds)]
    rows = zip(points.tolist(), levels.tolist(), strict=True)
    lines = [" ".join(map(repr, [*place, *colour])) for place, colour in rows]
    path.write_text("\n".join([*head, "end_header", *lines, ""]))
