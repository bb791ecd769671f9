# SPDX-License-Identifier: Apache-2.0
"""Loading of scenes: the pictures of a folder with their cameras, at the working size, split, checked, with points."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.config.checks import misfit
from clsplat.config.masks import NO_MASKS, MaskUse
from clsplat.config.training import Lenses, Missing
from clsplat.config.verbs import TEST_EVERY
from clsplat.errors import InputError, examples, plain, warn
from clsplat.files import digest
from clsplat.images.reading import image_size
from clsplat.progress import Progress
from clsplat.scenes.camera_checks import camera_checks
from clsplat.scenes.cloud import with_cloud_beside, without_stray_points
from clsplat.scenes.data_set import Lens, PosedImage
from clsplat.scenes.layouts import detect, read_colmap, read_transforms
from clsplat.scenes.masks import after_sfm, for_sfm, masks_of
from clsplat.scenes.scene import Scene, Split, View
from clsplat.scenes.sfm import reconstruct
from clsplat.scenes.strays import FACTOR

MAX_SIZE = 1600
"""Longest side in pixels where no resolution is asked for."""
UNEVEN = 1.5
"""Factor by which a picture's shape may differ from its camera's; from 4:3 to 16:9 it is a third. Beyond, or turned, it
is another picture."""
ROUNDED = 2.5
"""Pixels of the camera's size by which sides that were rounded can differ."""
BLENDER_CUBE = 1.3
"""Half the side of the cube that the synthetic scenes lie in, for random points: the authors' value."""


def load_scene(
    path: str | Path,
    *,
    resolution: int = 0,
    test_every: int = TEST_EVERY,
    images: str | Path | None = None,
    lenses: Lenses = "undistort",
    work_dir: Path | None = None,
    progress: Progress | None = None,
    masks: MaskUse = NO_MASKS,
    missing: Missing = "few",
) -> Scene:
    """Read a scene's cameras, points and picture headers; the pixels are read by `View.load`.

    path: a folder as `detect` knows, or a transforms.json. resolution: the longest side of the views in pixels, never
    larger than the pictures are; 0 keeps their size up to 1600. test_every: each n-th view by name is held out, 0 for
    none; a data set's own split goes before it. images: another folder of the pictures, relative to `path`, such as
    "images_4". Without it, images_2, images_4 or images_8 of a COLMAP scene stand in where their pictures have just the
    size that is wanted, and any of them where there are no others. lenses: fisheyes become pinhole cameras, or stay
    what they are ("native"). missing: how many of the listed pictures need not be there, "few" (a tenth), "skip" (any
    number but all) or "error" (none).

    A folder of photos goes through `clsplat.scenes.sfm` first, into work_dir (NAME_colmap beside it if not given),
    where a result for the same photos is found again; progress(text, fraction or None) is called on the way.

    Raises InputError naming the file for whatever is wrong with the input: see `detect`, `colmap.read_model` and
    `transforms.read_transforms`; pictures that are listed and missing, or of another size than their camera; pictures
    whose header does not decode. The scene's warnings name pictures that are there and not listed, but for masks,
    depths and the like (`reading.companions`), those on both sides of the split, those that are missing or found under
    other names, strays (`strays`), and cameras that cannot be right (`camera_checks`).

    masks: what masks and alpha channels mean (`clsplat.scenes.masks`); no other folder of pictures stands in then, and
    photos that go through sfm have no features where they leave something out.
    """
    path = Path(path)
    for name, number in (("resolution", resolution), ("test_every", test_every)):
        if (expected := misfit(int, number)) or number < 0:
            raise InputError(f"{name} {number}: expected {expected or '0 or more'}")
    kind = detect(path)
    if images is not None and kind == "photos":
        raise InputError(
            f"{path}: is a folder of photos, a folder of images can be chosen only where there are cameras"
        )
    smaller: list[Path] = []
    source = path
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if kind in ("blender", "transforms"):
            data = read_transforms(path, kind, images, missing, masks=masks.masks != "none")
        else:
            folder = path
            if kind == "photos":
                photos = path.resolve()
                folder = work_dir or photos.with_name(f"{photos.name}_colmap")
                folder = reconstruct(photos, folder, masks=for_sfm(masks), progress=progress)
                masks = after_sfm(masks, folder)
            source = folder
            data, smaller = read_colmap(folder, images, missing)
        posed = sorted(data.images, key=lambda image: image.name)
        if masks != NO_MASKS:
            smaller = []
        of_pictures = masks_of(masks, posed, path, strict=not data.missing)
        own_split = any(image.split for image in posed)
        every = {name: index for index, name in enumerate(sorted([*(image.rank for image in posed), *data.missing]))}
        views = []
        for image in posed:
            by_name = test_every > 0 and every[image.rank] % test_every == 0
            held_out = image.split == "test" if own_split else by_name
            view = _view(image, "test" if held_out else "train", resolution, smaller, lenses)
            views.append(replace(view, mask=of_pictures.get(image.name), depth_file=image.depth))
        _warn_of_copies(views)
        _warn_of_uneven(posed, views)
        cube = np.full(3, BLENDER_CUBE)
        name = path.resolve().name if path.is_dir() else path.resolve().parent.name
        scene = Scene(name, views, data.points, data.colors, (-cube, cube), source=source, clouds=tuple(data.clouds))
        scene.missing = tuple(data.missing)
        if len(scene.points) == 0:
            scene = with_cloud_beside(scene)
            if not len(scene.points) and kind in ("colmap", "photos"):
                warn(f"{path}: has no points, training starts from random ones")
        if kind != "blender":
            near = [view.camera for view in views if view.name not in scene.stray_cameras]
            scene.bounds = camera_bounds(near, data.box)
        scene = without_strays(scene)
        near_views = [view for view in views if view.name not in scene.stray_cameras]  # those are named
        for doubt in camera_checks([(view.name, view.camera, view.lens) for view in near_views], scene.points):
            warn(doubt)
    scene.warnings = [plain(str(warning.message)) for warning in caught]
    return scene


def without_strays(scene: Scene) -> Scene:
    """The scene without points that are strays. Warns of these, and of cameras that are."""
    if scene.stray_cameras:
        warn(
            f"{scene.name}: {len(scene.stray_cameras):,} camera(s) stand over {FACTOR:g} times as far off as the "
            f"others ({examples(sorted(scene.stray_cameras))}): the scene's size is that of the others; if their poses "
            "are wrong, correct them or leave them out"
        )
    kept = without_stray_points(scene.points, scene, scene.name)
    return scene if kept.all() else replace(scene, points=scene.points[kept], point_colors=scene.point_colors[kept])


def camera_bounds(cameras: list[Camera], box: tuple[Float64, Float64] | None = None) -> tuple[Float64, Float64]:
    """A cube (low, high) to put random points in: about the point that the cameras look at, as large as holds them.

    The point is nearest to all optical axes, drawn a little to one ahead of the cameras, which decides where the axes
    are parallel. Where the cameras look away from it (outward from one place) the cube is three times as large.
    Cut to `box` where they overlap.
    """
    centres = np.stack([camera.position for camera in cameras])
    axes = np.stack([camera.rotation[2] for camera in cameras])
    mean = centres.mean(axis=0)
    spread = float(np.linalg.norm(centres - mean, axis=1).max()) or 1.0
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    ahead = mean + spread * axes.mean(axis=0)
    pull = 1e-2
    matrix = across.mean(axis=0) + pull * np.eye(3)
    focus = np.linalg.solve(matrix, (across @ centres[:, :, None]).mean(axis=0)[:, 0] + pull * ahead)
    half = max(float(np.linalg.norm(centres - focus, axis=1).max()), spread)
    if np.median(np.sum((focus - centres) * axes, axis=1)) <= 0:
        half *= 3
    low, high = focus - half, focus + half
    if box is not None:
        inner_low, inner_high = np.maximum(low, box[0]), np.minimum(high, box[1])
        if (inner_low < inner_high).all():
            return inner_low, inner_high
    return low, high


def _warn_of_copies(views: list[View]) -> None:
    """A held-out picture that is trained on as well says nothing about how good the model is."""
    by_size: dict[int, list[View]] = {}
    for view in views:
        by_size.setdefault(view.path.stat().st_size, []).append(view)
    copies = []
    for same in by_size.values():
        if len({view.split for view in same}) > 1:
            trained = {digest(view.path): view.name for view in reversed(same) if view.split == "train"}
            held_out = [(view.name, trained.get(digest(view.path))) for view in same if view.split == "test"]
            copies += [f"{name} is {other}" for name, other in held_out if other is not None]
    if copies:
        warn(
            f"{len(copies)} of the held-out pictures are trained on too, as copies under another name, so that their "
            f"scores say little: {examples(sorted(copies))}; remove the copies"
        )


def _view(image: PosedImage, split: Split, resolution: int, smaller: list[Path], lenses: Lenses) -> View:
    """The image at the working size, its header checked."""
    lens, upright = _fit(image.path, image.lens)
    camera = lens.camera(image.rotation, image.translation, lenses)
    longest = max(camera.width, camera.height)
    scale = min(1.0, (resolution or MAX_SIZE) / longest)
    width, height = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    path = image.path
    if scale < 1 and lens.is_pinhole and not upright:
        for folder in smaller:
            candidate = folder / image.name
            if candidate.is_file() and _stands_in(candidate, width, height, lens):
                path = candidate
                width, height = image_size(path, orient=False)
                lens = lens.resized(width, height)
                break
    return View(image.name, camera.resized(width, height), path, split, lens, upright)


def _warn_of_uneven(images: Sequence[PosedImage], views: Sequence[View]) -> None:
    """Pictures that were resized by other factors across and down are taken so, as gsplat takes them. Pictures of
    another camera may look the same."""
    uneven = []
    for image, view in zip(images, views, strict=True):
        across, down = view.lens.width / image.lens.width, view.lens.height / image.lens.height
        by_one = max(abs(across - down) * image.lens.width, abs(across - down) * image.lens.height)
        if by_one > ROUNDED:
            uneven.append((image.name, across, down))
    if uneven:
        _, across, down = uneven[0]
        warn(
            f"{examples(name for name, *_ in uneven)}: {across:.4g} times as wide and {down:.4g} times as high as the "
            "camera's size, and taken as resized so; are these the pictures the cameras were computed from?"
        )


def _stands_in(path: Path, width: int, height: int, lens: Lens) -> bool:
    """True if a smaller picture has just the size that is wanted; tools round the shorter side up or down."""
    size = image_size(path, orient=False)
    near = abs(size[0] - width) <= 1 and abs(size[1] - height) <= 1
    return near and max(size) == max(width, height) and max(size) < max(lens.width, lens.height)


def _fit(path: Path, lens: Lens) -> tuple[Lens, bool]:
    """The lens at the file's size, and whether the picture is to be turned upright. Raises InputError by the path.

    COLMAP, instant-ngp and nerfstudio all take the pixels as stored. Where only the turned picture has the camera's
    proportions, another tool has turned it, and so it is turned.
    """
    stored = image_size(path, orient=False)
    if stored == (lens.width, lens.height):
        return lens, False
    turned = image_size(path, orient=True)
    if turned == (lens.width, lens.height):
        return lens, True
    for size, upright in ((stored, False), (turned, True)):
        scale = max(size) / max(lens.width, lens.height)
        if abs(lens.width * scale - size[0]) <= 1 and abs(lens.height * scale - size[1]) <= 1:
            return lens.resized(*size), upright
    if 1 / UNEVEN <= stored[0] / lens.width / (stored[1] / lens.height) <= UNEVEN:
        return lens.resized(*stored), False
    raise InputError(
        f"{path}: is {stored[0]} x {stored[1]} pixels, expected its camera's {lens.width} x {lens.height} or the same "
        "in another scale; are these the pictures the cameras were computed from?"
    )
