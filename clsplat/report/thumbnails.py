# SPDX-License-Identifier: Apache-2.0
"""Held-out photographs, renders and error pictures as data URIs that are small enough to embed in a page."""

from __future__ import annotations

import base64
import os
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import ArrayLike, NDArray

from clsplat.arrays import Float32
from clsplat.errors import InputError
from clsplat.evaluation.held_out import picture_names
from clsplat.images.alpha import composite
from clsplat.images.colour import displayed, photos_space
from clsplat.images.reading import downscale, read_image
from clsplat.images.writing import write_spec
from clsplat.runs.run import Run
from clsplat.scenes.folder_layouts import detect
from clsplat.scenes.loading import load_scene_of
from clsplat.scenes.scene import Scene, View
from clsplat.scenes.sfm.video_frames import reconstruction_folder
from clsplat.scenes.supervision.masks import after_sfm

MAX_PICTURE_SIDE_PX = 640
"""Maximum longer side in pixels of a picture in a page."""
MAX_PNG_SIDE_PX = 160
"""Maximum longer side in pixels of a picture that is stored as PNG and enlarged without smoothing."""
REPORT_JPEG_QUALITY = 85
MAX_COLOURED_ERROR = 0.25
"""Mean absolute error of a pixel's channels at the end of the colour map."""
INFERNO_RGB = np.array(
    [(0, 0, 0), (40, 11, 84), (101, 21, 110), (159, 42, 99), (212, 72, 66), (245, 125, 21), (250, 193, 39)], np.float32
)
"""Colour map of the error, from 0 to MAX_COLOURED_ERROR: matplotlib's inferno, in equal steps of lightness."""


@dataclass(frozen=True)
class Shown:
    """Pictures of a held-out view as data URIs: render, photograph, error and depth.

    width, height: size of the pictures in pixels.
    photo, error: None if there is no photograph.
    trouble: reason why the photograph cannot be read.
    depth: None if no depth picture was kept.
    """

    name: str
    width: int
    height: int
    render: str
    photo: str | None = None
    error: str | None = None
    trouble: str | None = None
    depth: str | None = None

    @property
    def small(self) -> bool:
        """True for a small picture, which is enlarged without smoothing."""
        return max(self.width, self.height) <= MAX_PNG_SIDE_PX


def scene_of(run: Run) -> Scene | str:
    """Load the run's scene, or return the reason why this is impossible.

    A report never runs structure from motion on a folder of photos.
    """
    source = run.scene
    if source is None:
        return "config.toml does not name the scene"
    masks = run.config.mask_use
    try:
        if detect(source) == "photos":
            source = reconstruction_folder(source.resolve())
            if not source.is_dir():
                return "the scene is a folder of photos or a video, and its reconstruction no longer exists"
            masks = after_sfm(masks, source)
        return load_scene_of(run.config, source, masks=masks)
    except (InputError, OSError) as error:
        return f"the scene cannot be read ({str(error).replace(str(source), source.name)})"


def chosen(scores: Sequence[float | None], limit: int) -> list[int]:
    """Choose at most `limit` views to show: the worst, the best, and others at even ranks between. Returns indices.

    scores: PSNR of each view in dB; None if it is unknown.
    """
    if len(scores) <= limit:
        return list(range(len(scores)))
    order = sorted(range(len(scores)), key=lambda index: (scores[index] is None, scores[index] or 0.0, index))
    places = np.linspace(0, len(order) - 1, limit).round().astype(int)
    return sorted({order[place] for place in places})


def show(
    run: Run,
    names: Sequence[str],
    wanted: Sequence[int],
    scene: Scene | None,
    background: ArrayLike,
    side: int = MAX_PICTURE_SIDE_PX,
) -> list[Shown]:
    """Make the pictures of held-out views whose renders are in test/ of the run folder.

    names: names of all held-out views.
    wanted: indices of the views to show.
    scene: the run's scene, for the photographs; None if there is no scene.
    background: colour behind the transparent parts of photographs.
    side: maximum longer side of a picture in pixels.
    """
    try:
        paths = picture_names(names)
    except ValueError:  # a view may have a name that no file can have, such as ""
        return []
    views = {view.name: view for view in scene.views} if scene is not None else {}
    space = photos_space(view.path for view in views.values())

    def one(index: int) -> Shown | None:
        path, depth = run.test_path / paths[index], run.depth_path / paths[index]
        if not _is_within(path, run.test_path):
            return None
        try:
            shown = _shown(names[index], path, views.get(names[index]), background, space, side)
        except InputError:
            return None
        if depth.is_file() and _is_within(depth, run.depth_path):
            with suppress(InputError):
                picture = read_image(depth, orient=False)[:, :, :3]
                shown = replace(shown, depth=data_uri(downscale(picture, shown.width, shown.height)))
        return shown

    with ThreadPoolExecutor(min(os.cpu_count() or 1, 8)) as pool:
        return [shown for shown in pool.map(one, wanted) if shown is not None]


def error_colors(error: Float32) -> Float32:
    """Map a mean absolute error (H, W) to colours (H, W, 3)."""
    at = np.clip(error / np.float32(MAX_COLOURED_ERROR), 0, 1) * (len(INFERNO_RGB) - 1)
    low = np.minimum(at.astype(int), len(INFERNO_RGB) - 2)
    part = (at - low)[..., None]
    colors: Float32 = ((1 - part) * INFERNO_RGB[low] + part * INFERNO_RGB[low + 1]) / np.float32(255)
    return colors


def data_uri(image: NDArray[Any]) -> str:
    """Encode an image (H, W, 3), clipped to [0, 1], as JPEG, or as PNG if it is small. Raises ClsplatError."""
    height, width = image.shape[:2]
    small = max(width, height) <= MAX_PNG_SIDE_PX
    kind = "png" if small else "jpeg"
    pixels = np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)
    spec = oiio.ImageSpec(width, height, 3, oiio.UINT8)
    if not small:
        spec.attribute("Compression", f"jpeg:{REPORT_JPEG_QUALITY}")
    with tempfile.TemporaryDirectory() as folder:  # OpenImageIO for Python can only write to files
        path = Path(folder) / f"picture.{kind}"
        write_spec(path, [pixels], [spec], kind)
        data = path.read_bytes()
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def _is_within(path: Path, folder: Path) -> bool:
    """True if the path is in the folder, after links are resolved."""
    try:
        return path.resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError):
        return False


def _shown(name: str, path: Path, view: View | None, background: ArrayLike, space: str, side: int) -> Shown:
    render = read_image(path, orient=False)[:, :, :3]
    height, width = render.shape[:2]
    scale = min(1.0, side / max(width, height))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = downscale(render, *size)
    if view is None:
        return Shown(name, *size, data_uri(small))
    try:
        photo = displayed(composite(view.load(width, height), background), space)
    except InputError as reason:
        trouble = str(reason).replace(str(view.path), view.path.name)
        return Shown(name, *size, data_uri(small), trouble=trouble)
    error = np.abs(photo - render).mean(axis=2, keepdims=True, dtype=np.float32)
    colors = error_colors(downscale(error, *size)[:, :, 0])
    return Shown(name, *size, data_uri(small), data_uri(downscale(photo, *size)), data_uri(colors))
