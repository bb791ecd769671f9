# SPDX-License-Identifier: Apache-2.0
"""Scenes: a folder of pictures with cameras, of any layout that `detect` knows, as views and points."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.camera import NEAR, NEARS, Camera
from clsplat.config.checks import misfit
from clsplat.config.depth import NO_DEPTH, DepthUse
from clsplat.config.masks import NO_MASKS, MaskUse
from clsplat.config.points import OWN_POINTS, StartPoints
from clsplat.config.training import Lenses
from clsplat.config.verbs import TEST_EVERY
from clsplat.errors import InputError, examples, plain, warn
from clsplat.files import digest, short_digest
from clsplat.images.reading import companions, downscale, find_images, image_size, read_image, require_images
from clsplat.progress import Progress
from clsplat.scenes import colmap, transforms
from clsplat.scenes.data_set import DataSet, Lens, PosedImage, undistort
from clsplat.scenes.glance import Glance, glance_at
from clsplat.scenes.known_depth import KnownDepth
from clsplat.scenes.masks import HALF, Mask, after_sfm, for_sfm, masks_of
from clsplat.scenes.sfm import reconstruct

Kind = Literal["colmap", "blender", "transforms", "photos"]
Split = Literal["train", "test"]
T = TypeVar("T")

MAX_SIZE = 1600
"""Longest side in pixels where no resolution is asked for."""
FAR = 64.0
"""Distance of a scene from the world's origin, in its own sizes, beyond which its means count from its middle: float32
there knows places to 64 * 2^-24 of the size, a hundredth of a pixel of 2600 across the scene."""
ROUNDING = 1e-12
"""Cameras that are nearer than this to each other, as a part of how far they are from the origin, are in one place."""
BLENDER_CUBE = 1.3
"""Half the side of the cube that the synthetic scenes lie in, for random points: the authors' value."""


@dataclass(frozen=True, eq=False)
class View:
    """A picture and the camera that took it.

    name: as in the data set, with extension, unique in the scene; camera: at the working size; path: the file that is
    read; split: "train" or "test"; lens: what the file was taken through, at the file's size; upright: the camera
    belongs to the picture turned as its EXIF orientation says, not as stored; mask: what of the picture counts, None
    for all; depth_file: the depth map that the data set names; depth: what training knows of depths.
    """

    name: str
    camera: Camera
    path: Path
    split: Split
    lens: Lens
    upright: bool = False
    mask: Mask | None = None
    depth_file: Path | None = None
    depth: KnownDepth | None = None

    def load(self, width: int | None = None, height: int | None = None) -> Float32:
        """Read the pixels, float32 (H, W, 3), or (H, W, 4) with straight alpha, undistorted, of the camera's size.

        width, height: another size. Reads the file each time. What a mask leaves out is black, or transparent. Raises
        InputError for one that does not decode or has changed its size since.
        """
        image = self.load_masked(width, height)
        return image if image.shape[2] < 5 else np.ascontiguousarray(image[:, :, : 3 + _has_alpha(image)])

    def load_masked(self, width: int | None = None, height: int | None = None) -> Float32:
        """The same; if something is left out with five channels, the last 1 where a pixel counts, else 0.

        A pixel counts if half of its area does. Its colour is the mean of that part alone, so that none leaks in.
        """
        width, height = width or self.camera.width, height or self.camera.height
        image = self._read()
        if self.mask is None:
            return self._fitted(image, width, height)
        image, counts = self.mask.applied(image, orient=self.upright)
        if counts is None:
            return self._fitted(image, width, height)
        parts = [np.where(counts > 0, image[:, :, :3], np.float32(0)), counts]
        if image.shape[2] == 4:  # alpha is averaged where it counts, as a colour
            there = np.where(counts > 0, image[:, :, 3:], np.float32(0))
            alpha = self._fitted(np.concatenate([there, there, there, counts], axis=2), width, height)
            parts[0] = parts[0] * there
        scaled = self._fitted(np.concatenate(parts, axis=2), width, height)
        whole = scaled[:, :, 3:] >= HALF
        opacity = np.clip(alpha[:, :, :1], 0, 1) if image.shape[2] == 4 else np.ones_like(scaled[:, :, :1])
        colour = scaled[:, :, :3] / np.where(opacity > 0, opacity, np.float32(1))
        result = np.concatenate([colour, opacity, np.ones_like(opacity)], axis=2)
        return np.ascontiguousarray(np.where(whole, result, np.float32(0)), np.float32)

    def _fitted(self, image: Float32, width: int, height: int) -> Float32:
        if self.lens.is_pinhole or self.camera.projection != "perspective":
            return downscale(image, width, height)
        return undistort(image, self.lens, self.camera.resized(width, height))

    def check(self) -> Glance:
        """A glance at the picture. Raises InputError where `load` would."""
        image = self._read()
        if self.mask is not None:
            self.mask.applied(image, orient=self.upright)
        return glance_at(image)

    def _read(self) -> Float32:
        image = read_image(self.path, orient=self.upright)
        if image.shape[:2] != (self.lens.height, self.lens.width):
            actual = f"{image.shape[1]} x {image.shape[0]}"
            raise InputError(f"{self.path}: is {actual} pixels now, expected {self.lens.width} x {self.lens.height}")
        return image


@dataclass(eq=False)
class Scene:
    """A scene to train on.

    name: the folder's; views sorted by name; points (N, 3) float64 in the world, N may be 0; point_colors (N, 3)
    float32 in [0, 1]; bounds: corners (low, high), each (3,) float64, world units, of the box for random initial
    points; warnings: for the user, a line each; start: how the points were chosen (`scenes.cloud`); colourless (N,):
    points whose colours are those of the photographs, None for none; source: the folder that it was read from;
    depth_use: how what is known of depths was chosen (`scenes.depth`).
    """

    name: str
    views: list[View]
    points: Float64
    point_colors: Float32
    bounds: tuple[Float64, Float64]
    warnings: list[str] = field(default_factory=list)
    start: StartPoints = OWN_POINTS
    colourless: NDArray[np.bool_] | None = None
    source: Path | None = None
    depth_use: DepthUse = NO_DEPTH

    @cached_property
    def train_views(self) -> list[View]:
        """Views to train on, by name."""
        return [view for view in self.views if view.split == "train"]

    @cached_property
    def test_views(self) -> list[View]:
        """Views held out, by name."""
        return [view for view in self.views if view.split == "test"]

    def require_training_views(self) -> list[View]:
        """Views to train on. Raises InputError where there are none."""
        if not self.train_views:
            count = len(self.views)
            raise InputError(f"{self.name}: all {count} views are held out; use --test-every 0 to hold out none")
        return self.train_views

    def check_pictures(self) -> None:
        """Decode every picture once, so that a cut one is named before training and not in the middle of it; the
        `digests` and `glances` are made on the way.

        Raises InputError for the first by name that does not decode.
        """
        found = self._of_each(lambda view: (_digest(view), view.check()))
        self.__dict__["digests"] = {name: digest for name, (digest, _) in found.items()}
        self.__dict__["glances"] = {name: glance for name, (_, glance) in found.items()}

    @cached_property
    def glances(self) -> dict[str, Glance]:
        """A glance at each picture, by the view's name. Raises InputError as `check_pictures`."""
        return self._of_each(View.check)

    @cached_property
    def digests(self) -> dict[str, str | None]:
        """Digest of each view's file, with that of its mask, by the view's name."""
        return self._of_each(_digest)

    def _of_each(self, work: Callable[[View], T]) -> dict[str, T]:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            try:
                return {view.name: result for view, result in zip(self.views, pool.map(work, self.views), strict=True)}
            finally:
                pool.shutdown(cancel_futures=True)

    @cached_property
    def origin(self) -> Float64:
        """Point that the means of a model of this scene should count from, (3,) in the world: 0 unless the scene is far
        off.

        The middle of the cameras, in whole steps of about the scene's size.
        """
        centres = np.stack([view.camera.position for view in self.views])
        middle = centres.mean(axis=0)
        size = float(np.linalg.norm(centres - middle, axis=1).max())
        if len(self.points):
            size = max(size, float(np.median(np.linalg.norm(self.points - middle, axis=1))))
        if size == 0 or np.linalg.norm(middle) < FAR * size:
            return np.zeros(3)
        step = 2.0 ** np.ceil(np.log2(size))
        return np.asarray(np.round(middle / step) * step)

    @cached_property
    def _spread(self) -> tuple[Float64, float, float]:
        """The middle of the training cameras, how far the farthest is from there, and their largest coordinate."""
        centres = np.stack([view.camera.position for view in self.train_views or self.views])
        middle: Float64 = centres.mean(axis=0)
        return middle, float(np.linalg.norm(centres - middle, axis=1).max()), float(np.abs(centres).max())

    @property
    def in_one_place(self) -> bool:
        """True if all training cameras are in one place, but for rounding."""
        _, spread, largest = self._spread
        return spread <= ROUNDING * largest

    @cached_property
    def extent(self) -> float:
        """The authors' cameras_extent, world units: 1.1 times the farthest training camera's distance from their mean.

        If the cameras are all in one place, the median distance of the points from there, or 1 if there are none: it
        scales the learning rates.
        """
        middle, spread, _ = self._spread
        if not self.in_one_place:
            return 1.1 * spread
        return (float(np.median(np.linalg.norm(self.points - middle, axis=1))) if len(self.points) else 0.0) or 1.0

    @cached_property
    def near(self) -> float:
        """The near plane of a model of this scene, world units (docs/decisions/0019)."""
        return min(NEAR, self.extent / NEARS)


def _has_alpha(image: Float32) -> bool:
    """True if a picture with a mask is not opaque wherever it counts."""
    return bool((image[:, :, 3] < image[:, :, 4]).any())


def _digest(view: View) -> str | None:
    own = short_digest(view.path)
    if view.mask is not None:
        own = f"{own} {view.mask.use} {view.mask.path and short_digest(view.mask.path)}"
    return own if view.depth is None else f"{own} depth {view.depth.digest}"


def detect(path: Path) -> Kind:
    """Layout of a scene's folder (or transforms.json). Raises InputError if it has none, naming what was looked for."""
    path = Path(path)
    if path.is_file():
        if path.suffix.lower() != ".json":
            raise InputError(f"{path}: is a file, expected a scene's folder or a transforms.json")
        return "blender" if path.name == "transforms_train.json" else "transforms"
    if not path.is_dir():
        raise InputError(f"{path}: no such folder, expected a scene")
    if (path / "transforms_train.json").is_file():
        return "blender"
    model = colmap.find_model(path)
    # nerfstudio keeps the COLMAP model that its transforms.json was made from, of larger pictures, below colmap/
    if model is not None and not (model.is_relative_to(path / "colmap") and (path / "transforms.json").is_file()):
        return "colmap"
    if (path / "transforms.json").is_file():
        return "transforms"
    if find_images(path):
        return "photos"
    raise InputError(
        f"{path}: no images found, nor sparse/, transforms_train.json or transforms.json; expected a COLMAP, Blender, "
        "nerfstudio or instant-ngp scene, or a folder of photos"
    )


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
) -> Scene:
    """Read a scene's cameras, points and picture headers; the pixels are read by `View.load`.

    path: a folder as `detect` knows, or a transforms.json. resolution: the longest side of the views in pixels, never
    larger than the pictures are; 0 keeps their size up to 1600. test_every: each n-th view by name is held out, 0 for
    none; a data set's own split goes before it. images: another folder of pictures for a COLMAP model, relative to
    `path`, such as "images_4". Without it, images_2, images_4 or images_8 stand in where their pictures have just the
    size that is wanted. lenses: fisheyes become pinhole cameras, or stay what they are ("native").

    A folder of photos goes through `clsplat.scenes.sfm` first, into work_dir (NAME_colmap beside it if not given),
    where a result for the same photos is found again; progress(text, fraction or None) is called on the way.

    Raises InputError naming the file for whatever is wrong with the input: see `detect`, `colmap.read_model` and
    `transforms.read_transforms`; pictures that are listed and missing, or of another size than their camera; pictures
    whose header does not decode. Pictures that are there and not listed are named in the scene's warnings, but for
    masks, depths and the like (`reading.companions`), and so are those on both sides of the split.

    masks: what masks and alpha channels mean (`clsplat.scenes.masks`); no other folder of pictures stands in then, and
    photos that go through sfm have no features where they leave something out.
    """
    path = Path(path)
    for name, number in (("resolution", resolution), ("test_every", test_every)):
        if (expected := misfit(int, number)) or number < 0:
            raise InputError(f"{name} {number}: expected {expected or '0 or more'}")
    kind = detect(path)
    if images is not None and kind != "colmap":
        raise InputError(f"{path}: is a {kind} scene, a folder of images can be chosen only for a COLMAP one")
    smaller: list[Path] = []
    source = path
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if kind in ("blender", "transforms"):
            data = _read_transforms(path, kind, masks=masks.masks != "none")
        else:
            folder = path
            if kind == "photos":
                photos = path.resolve()
                folder = work_dir or photos.with_name(f"{photos.name}_colmap")
                folder = reconstruct(photos, folder, masks=for_sfm(masks), progress=progress)
                masks = after_sfm(masks, folder)
            source = folder
            data, smaller = _read_colmap(folder, images)
        posed = sorted(data.images, key=lambda image: image.name)
        if masks != NO_MASKS:
            smaller = []
        of_pictures = masks_of(masks, posed, path)
        own_split = any(image.split for image in posed)
        views = []
        for index, image in enumerate(posed):
            held_out = image.split == "test" if own_split else test_every > 0 and index % test_every == 0
            view = _view(image, "test" if held_out else "train", resolution, smaller, lenses)
            views.append(replace(view, mask=of_pictures.get(image.name), depth_file=image.depth))
        _warn_of_copies(views)
    if kind == "blender":
        bounds = (np.full(3, -BLENDER_CUBE), np.full(3, BLENDER_CUBE))
    else:
        bounds = camera_bounds([view.camera for view in views], data.box)
    name = path.resolve().name if path.is_dir() else path.resolve().parent.name
    told = [plain(str(warning.message)) for warning in caught]
    return Scene(name, views, data.points, data.colors, bounds, told, source=source)


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


def _read_colmap(path: Path, chosen: str | Path | None) -> tuple[DataSet, list[Path]]:
    """The data set, and the folders of downscaled pictures that may stand in."""
    model_path = colmap.find_model(path)
    assert model_path is not None  # detect has found it
    model = colmap.read_model(model_path)
    if len(model.points) == 0:
        warn(f"{model_path}: has no points, training starts from random ones")
    # The model's own folder may be what was given: then the pictures are beside one of those above it.
    above = [path, *path.resolve().parents[:2]] if model_path == path else [path]
    if chosen is not None:
        folder = path / chosen
        if not folder.is_dir():
            raise InputError(f"{folder}: no such folder, expected the images of {model_path}")
    else:
        candidates = [parent / "images" for parent in above]
        folder = next((candidate for candidate in candidates if candidate.is_dir()), candidates[0])
        if not folder.is_dir():
            raise InputError(f"{folder}: no such folder, expected the {len(model.images)} images of {model_path}")
    present = find_images(folder)
    if not present:
        raise InputError(f"{folder}: no images found, expected the {len(model.images)} of {model_path}")
    model.images = [replace(image, path=folder / image.name) for image in model.images]
    require_images([image.path for image in model.images], model_path)
    _warn_of_unlisted(present, model, model_path, folder)
    smaller = [] if chosen is not None else [folder.with_name(f"{folder.name}_{factor}") for factor in (2, 4, 8)]
    return model, [candidate for candidate in smaller if candidate.is_dir()]


def _read_transforms(path: Path, kind: Kind, *, masks: bool) -> DataSet:
    folder = path.parent if path.is_file() else path
    if kind == "blender":
        data = transforms.read_blender(folder)
        listed_in = folder / "transforms_*.json"
    else:
        listed_in = path if path.is_file() else folder / "transforms.json"
        data = transforms.read_transforms(listed_in, masks=masks)
    parents = {image.path.parent for image in data.images}
    present = [file for parent in parents for file in find_images(parent, deep=False)]
    _warn_of_unlisted(present, data, listed_in, folder)
    return data


def _warn_of_unlisted(present: list[Path], data: DataSet, listed_in: Path, folder: Path) -> None:
    listed = {image.path for image in data.images}
    unlisted = sorted(path for path in present if path not in listed)
    known = companions(unlisted, listed, folder) if unlisted else set()
    if unlisted := [path for path in unlisted if path not in known]:
        warn(
            f"{listed_in}: does not list {len(unlisted):,} image(s) that are there, and they are not used: "
            f"{examples(unlisted)}"
        )


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
    raise InputError(
        f"{path}: is {stored[0]} x {stored[1]} pixels, expected its camera's {lens.width} x {lens.height} or the same "
        "in another scale; are these the pictures the cameras were computed from?"
    )
