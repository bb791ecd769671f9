# SPDX-License-Identifier: Apache-2.0
"""Make the experiments' scenes: the demo's, an RGB-D sequence, captures by the ray caster, disturbed scenes."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from ring import write_cloud

from clsplat.arrays import Float32, Float64
from clsplat.camera import Camera
from clsplat.config.cli_defaults import TEST_EVERY
from clsplat.config.masks import MaskUse
from clsplat.config.training import TrainConfig
from clsplat.demo.ray_caster import Floor, Surface, Wall, bake, cameras, render, still_life
from clsplat.demo.town.blocks import BLOCK_METRES, GROUND_FACE
from clsplat.demo.town.flights import TownPhotograph, photographs
from clsplat.demo.town.settings import TownConfig
from clsplat.demo.town.solids import FACES_PER_SOLID
from clsplat.demo.town.visibility import Caster, blocks_in_sight
from clsplat.demo.town.writing import TOWN_RECORD_FILE
from clsplat.errors import InputError
from clsplat.images.alpha import Image, composite
from clsplat.images.reading import downscale, open_image, read_image
from clsplat.images.writing import write_image
from clsplat.reference.appearance import spread
from clsplat.reference.cameras import cam_from_pixel, pixel_grid
from clsplat.reference.ppisp import light
from clsplat.runs.appearance import unmixing
from clsplat.scenes.dataset import Lens
from clsplat.scenes.loading import load_scene
from clsplat.scenes.readers.colmap_writer import write_model
from clsplat.scenes.readers.transforms import COLMAP_FROM_OPENGL
from clsplat.scenes.scene import Scene, View
from clsplat.training.cameras.poses import Poses

FARTHEST = 6.0
"""Largest depth of an RGB-D camera that is used, in metres."""
ROUNDS = 3
"""How many times the block crosses the picture from the first photograph to the last."""
RADIAL = (0.03, -0.012, 0.003, -0.0004)
"""Distortion coefficients of the fisheye, which move points by a few pixels."""
ANGLE = np.deg2rad(190)
"""Angle of view of the fisheye."""
FISHEYE_POINTS = 4000

Capture = tuple[list[Camera], list[Float32], list[Float32]]
"""Cameras, photographs and depths (H, W), 0 where a depth is not known."""


def baked(seed: int) -> list[Surface]:
    """The demo's surfaces, with lighting."""
    surfaces = still_life()
    bake(surfaces, seed)
    return surfaces


def nearest(surfaces: list[Surface], camera: Camera, rays: NDArray[Any]) -> tuple[Float32, NDArray[Any], Float32]:
    """Distances (N,) along unit rays (N, 3) of the camera, indices (N,) of the surfaces that they hit, and the rays'
    directions (N, 3) in the world."""
    directions = (rays @ camera.rotation).astype(np.float32)
    distances = np.stack([surface.distance(camera.position.astype(np.float32), directions) for surface in surfaces])
    return distances.min(axis=0), distances.argmin(axis=0), directions


def depth_of(surfaces: list[Surface], camera: Camera) -> Float32:
    """Depths (H, W) along the camera's axis at the pixels' centres, 0 where no surface is hit."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=2).reshape(-1, 3)
    lengths = np.linalg.norm(rays, axis=1, keepdims=True)
    distances, _, _ = nearest(surfaces, camera, rays / lengths)
    depth = np.where(np.isfinite(distances), distances / lengths[:, 0], 0)
    return depth.reshape(camera.height, camera.width).astype(np.float32)


def demo(width: int, photos: int, seed: int) -> Capture:
    """A capture of the demo's scene. width: of the photographs, in pixels. photos: their number."""
    surfaces, views = baked(seed), cameras(photos, width, width * 3 // 4, seed)
    with ThreadPoolExecutor(2) as pool:
        pictures = [np.asarray(picture, np.float32) for picture in pool.map(partial(render, surfaces), views)]
        return views, pictures, list(pool.map(partial(depth_of, surfaces), views))


def rgbd(folder: Path, width: int, photos: int) -> Capture:
    """The capture of an RGB-D sequence: frame-N.color.jpg, .depth.png (16 bit, mm), .pose.txt, camera-intrinsics.txt.

    A pixel has the depth of the map's nearest pixel.
    width: of the photographs, in pixels.
    photos: maximum number of photographs.
    """
    matrix = np.loadtxt(folder / "camera-intrinsics.txt")
    files = sorted(folder.glob("frame-*.color.jpg"))
    views, pictures, depths = [], [], []
    for file in files[:: max(len(files) // photos, 1)][:photos]:
        stem = file.name.removesuffix(".color.jpg")
        pose = np.linalg.inv(np.loadtxt(folder / f"{stem}.pose.txt")).astype(np.float64)
        picture = read_image(file)
        full = (picture.shape[1], picture.shape[0])
        lens = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
        view = Camera(*full, *lens, pose[:3, :3], pose[:3, 3]).resized(width, width * full[1] // full[0])
        source = open_image(folder / f"{stem}.depth.png")
        levels = np.asarray(source.read_image("uint16")).reshape(full[1], full[0])
        source.close()
        rows = ((np.arange(view.height) + 0.5) * full[1] / view.height).astype(int)
        columns = ((np.arange(view.width) + 0.5) * full[0] / view.width).astype(int)
        depth = levels[rows][:, columns] / np.float32(1000)
        views.append(view)
        pictures.append(downscale(picture, view.width, view.height))
        depths.append(np.where(depth < FARTHEST, depth, 0).astype(np.float32))
    return views, pictures, depths


def cut_out(surfaces: list[Surface], camera: Camera) -> Float32:
    """The ray caster's picture (H, W, 4) of only these surfaces, with straight alpha and four rays per pixel."""
    fine = camera.resized(2 * camera.width, 2 * camera.height)
    hit = (depth_of(surfaces, fine) > 0).astype(np.float32)[:, :, None]
    both = np.concatenate([render(surfaces, fine, samples=1) * hit, hit], axis=2)
    return downscale(both, camera.width, camera.height)


def turntable(photos: int, seed: int) -> Capture:
    """A capture of the still life's objects, cut out of their surroundings."""
    things = [surface for surface in baked(seed) if not isinstance(surface, Floor | Wall)]
    views = cameras(photos, 160, 120, seed)
    with ThreadPoolExecutor(2) as pool:
        pictures = list(pool.map(partial(cut_out, things), views))
        return views, pictures, list(pool.map(partial(depth_of, things), views))


def write_transforms(folder: Path, capture: Capture, counts: tuple[int, int], seed: int) -> Path:
    """Write a capture as nerfstudio's transforms.json, which names sparse.ply, and write dense.ply beside it.

    counts: numbers of sparse and dense points, which are drawn at random from the depths.
    """
    for name in ("images", "depths"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    frames: list[dict[str, Any]] = []
    points, colors = [], []
    for index, (view, picture, depth) in enumerate(zip(*capture, strict=True)):
        write_image(folder / "images" / f"{index:03d}.png", picture)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = view.rotation.T @ COLMAP_FROM_OPENGL, view.position
        lens = {"fl_x": view.fx, "fl_y": view.fy, "cx": view.cx, "cy": view.cy, "w": view.width, "h": view.height}
        np.save(folder / "depths" / f"{index:03d}.npy", depth)
        files = {"file_path": f"images/{index:03d}.png", "depth_file_path": f"depths/{index:03d}.npy"}
        frames.append({**files, **lens, "transform_matrix": matrix.tolist()})
        if index % TEST_EVERY:  # held-out pictures contribute no points
            rows, columns = np.nonzero(depth)
            z = depth[rows, columns].astype(float)
            x, y = (columns + 0.5 - view.cx) / view.fx * z, (rows + 0.5 - view.cy) / view.fy * z
            points.append((np.stack([x, y, z], axis=1) - view.translation) @ view.rotation)
            colors.append(picture[rows, columns])
    every, shades = np.concatenate(points), np.concatenate(colors)
    for name, count in zip(("sparse", "dense"), counts, strict=True):
        chosen = np.sort(np.random.default_rng(seed).permutation(len(every))[:count])
        write_cloud(folder / f"{name}.ply", every[chosen], np.rint(255 * shades[chosen, :3]))
    document = {"ply_file_path": "sparse.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document), "utf-8")
    return folder


def fisheye_of(pinhole: Camera, side: int) -> Camera:
    """The fisheye at a pinhole camera's pose. Its picture is a square of this side, as wide as its circle of 190
    degrees."""
    theta = ANGLE / 2
    reach = theta * (1 + sum(k * theta ** (2 * power) for power, k in enumerate(RADIAL, 1)))
    focal, middle = side / 2 / reach, side / 2
    lens = {"fx": focal, "fy": focal, "cx": middle, "cy": middle, "projection": "fisheye", "radial": RADIAL}
    return replace(pinhole, width=side, height=side, **lens)


def circle(camera: Camera) -> NDArray[np.bool_]:
    """Pixels (H, W) that a fisheye of 190 degrees shows."""
    rays = np.nan_to_num(cam_from_pixel(camera, pixel_grid(camera))[1])
    inside: NDArray[np.bool_] = np.any(rays != 0, axis=1) & (rays[:, 2] > np.cos(ANGLE / 2))
    return inside.reshape(camera.height, camera.width)


def photograph(surfaces: list[Surface], camera: Camera, samples: int = 2) -> Float32:
    """The ray caster's picture of a camera of any projection, without gloss, with samples^2 rays per pixel; black
    beyond 190 degrees."""
    fine = camera.resized(camera.width * samples, camera.height * samples)
    rays = np.nan_to_num(cam_from_pixel(fine, pixel_grid(fine))[1])
    shown = circle(fine).ravel() if camera.projection == "fisheye" else np.any(rays != 0, axis=1)
    distances, hit, directions = nearest(surfaces, camera, rays[shown])
    seen = np.zeros_like(directions)
    for index, surface in enumerate(surfaces):
        chosen = np.flatnonzero((hit == index) & np.isfinite(distances))
        points = camera.position.astype(np.float32) + distances[chosen, None] * directions[chosen]
        seen[chosen] = surface.colour(points)
    colours = np.zeros((len(rays), 3), np.float32)
    colours[shown] = seen
    linear = colours.reshape(camera.height, samples, camera.width, samples, 3).mean(axis=(1, 3))
    return np.asarray(np.clip(linear, 0, 1) ** np.float32(1 / 1.6), np.float32)


def write_colmap(folder: Path, surfaces: list[Surface], views: list[Camera]) -> Path:
    """Write a COLMAP scene of the cameras' photographs, with points on the surfaces. Masks hide the pixels
    around a fisheye's circle."""
    one, fisheye = views[0], views[0].projection == "fisheye"
    for name in ("images", "masks") if fisheye else ("images",):
        (folder / name).mkdir(parents=True, exist_ok=True)
    numbers = (one.fx, one.fy, one.cx, one.cy)
    size, names = (one.width, one.height), [f"{index:03d}.png" for index in range(len(views))]
    lens = Lens("OPENCV_FISHEYE", *size, (*numbers, *one.radial)) if fisheye else Lens("PINHOLE", *size, numbers)
    with ThreadPoolExecutor(2) as pool:
        for name, picture in zip(names, pool.map(partial(photograph, surfaces), views), strict=True):
            write_image(folder / "images" / name, picture)
            if fisheye:
                shown = np.repeat(circle(one)[:, :, None], 3, axis=2).astype(np.float32)
                write_image(folder / "masks" / name, shown)
    rng, points, colours = np.random.default_rng(1), [], []
    for surface in surfaces:
        places = rng.random((2, FISHEYE_POINTS // len(surfaces))).astype(np.float32)
        points.append(surface.point(places[0], places[1])[0])
        colours.append(np.clip(surface.colour(points[-1]), 0, 1) ** (1 / 1.6))
    levels = (255 * np.concatenate(colours)).astype(np.uint8)
    shades = (levels / np.float32(255)).astype(np.float32)
    images = [(name, lens, view) for name, view in zip(names, views, strict=True)]
    write_model(folder / "sparse" / "0", images, np.concatenate(points), shades)
    return folder


def pattern(width: int, height: int, seed: int) -> Float32:
    """A picture (H, W, 3) of squares in random colours."""
    side = max(width // 24, 1)
    colours = np.random.default_rng(seed).random((height // side + 1, width // side + 1, 3)).astype(np.float32)
    return np.asarray(colours.repeat(side, axis=0).repeat(side, axis=1)[:height, :width])


def with_block(scene: Path, folder: Path, seed: int) -> Path:
    """Write the COLMAP scene with a block on each training photograph, and masks of it. seed: of the block's pixels."""
    if not (scene / "sparse" / "0").is_dir():
        raise InputError(f"{scene / 'sparse' / '0'}: no such folder, expected a COLMAP scene")
    for name in ("images", "masks", "sparse/0"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    try:
        model = pycolmap.Reconstruction(scene / "sparse" / "0")
    except (ValueError, RuntimeError) as error:
        raise InputError(f"{scene / 'sparse' / '0'}: {error}, expected a COLMAP model") from None
    images = sorted(model.images.values(), key=lambda image: image.name)
    for index, image in enumerate(images):
        picture = composite(read_image(scene / "images" / image.name, orient=False), (0, 0, 0))
        image.name = f"{index:06d}.png"
        if index % TEST_EVERY:
            height, width = picture.shape[:2]
            across, down = width // 3, height // 4
            turn = ROUNDS * index / len(images) % 1
            left, top = round(turn * (width - across)), round((0.5 + 0.4 * np.sin(7 * turn)) * (height - down))
            mask = np.ones((height, width, 3), np.float32)
            mask[top : top + down, left : left + across] = 0
            picture = np.where(mask > 0, picture, pattern(width, height, seed))
            write_image(folder / "masks" / image.name, mask)
        write_image(folder / "images" / image.name, picture)
    model.write(folder / "sparse" / "0")
    return folder


def without_colours(scene: Path, folder: Path) -> Path:
    """Write a COLMAP scene with grey points. Its photographs are linked."""

    def grey(model: Any) -> None:
        for point in model.points3D.values():
            point.color = np.full(3, 128, np.uint8)

    return remodelled(scene, folder, grey)


def remodelled(scene: Path, folder: Path, change: Callable[[Any], None]) -> Path:
    """Write a COLMAP scene with a changed model, unless `folder` exists. Its photographs are linked.

    change: changes the model in place.
    """
    if not folder.exists():
        model = pycolmap.Reconstruction(scene / "sparse" / "0")
        change(model)
        (folder / "sparse" / "0").mkdir(parents=True)
        (folder / "images").symlink_to((scene / "images").resolve())
        model.write_binary(folder / "sparse" / "0")
    return folder


def picked(scene: Scene, count: int) -> Scene:
    """The scene with `count` of its training views, evenly spaced by name, including the first and the last."""
    names = [view.name for view in scene.train_views]
    places = np.rint(np.linspace(0, len(names) - 1, min(count, len(names)))).astype(int)
    kept = {names[place] for place in places}
    return replace(scene, views=[view for view in scene.views if view.split == "test" or view.name in kept])


def in_units(scene: Scene, factor: float, offset: Float64) -> Scene:
    """The scene with its world scaled by factor, and then moved by offset (3,)."""

    def moved(camera: Camera) -> Camera:
        return replace(camera, translation=factor * camera.translation - camera.rotation @ offset)

    views = [replace(view, camera=moved(view.camera)) for view in scene.views]
    low, high = (factor * corner + offset for corner in scene.bounds)
    return Scene(scene.name, views, factor * scene.points + offset, scene.point_colors, (low, high))


def rescaled(folder: Path, factor: float) -> Path:
    """Write a COLMAP scene whose world is scaled by factor, and return its folder. Its photographs are linked."""
    larger = pycolmap.Sim3d(factor, pycolmap.Rotation3d(), np.zeros(3))
    return remodelled(
        folder, folder.with_name(f"{folder.name}-times-{factor:g}"), lambda model: model.transform(larger)
    )


def own_blocks(town: Path) -> Scene:
    """A town at the origin whose photographs count only where they show their own block.

    Masks leave out the other pixels, and points beyond the town's blocks are dropped. So no block depends on its
    neighbours.
    """
    settings = json.loads((town / TOWN_RECORD_FILE).read_text("utf-8"))["town"]
    config = TownConfig(**settings | {"origin": tuple(settings["origin"])})
    for i, j in np.ndindex(config.columns, config.rows):
        for shot in photographs(config, i, j):
            path = town / "masks" / f"{shot.name}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            if not path.exists():
                write_image(path, own_block_mask(config, shot).astype(np.uint8) * 255)
    scene = load_scene(town, masks=MaskUse(masks="ignore"))
    x, y = scene.points.T[:2] / BLOCK_METRES
    kept = (x >= 0) & (x <= config.columns) & (y >= 0) & (y <= config.rows)
    return replace(scene, points=scene.points[kept], point_colors=scene.point_colors[kept])


def single_blocks(town: Scene) -> list[Scene]:
    """Each block of a town from `own_blocks` as a scene of its own, sorted by name."""
    blocks = []
    for name in sorted({view.name.split("/")[0] for view in town.views}):
        own = (np.floor(town.points[:, :2] / BLOCK_METRES) == [int(number) for number in name.split("_")]).all(axis=1)
        views = [view for view in town.views if view.name.startswith(f"{name}/")]
        points, colours = town.points[own], town.point_colors[own]
        blocks.append(replace(town, name=f"{town.name} {name}", views=views, points=points, point_colors=colours))
    return blocks


def own_block_mask(config: TownConfig, shot: TownPhotograph) -> NDArray[np.bool_]:
    """The pixels (H, W) of a town's photograph that show nothing but its own block."""
    blocks = blocks_in_sight(config.seed, shot.camera)
    caster = Caster(shot.camera, blocks)
    sight = caster.sight(0, shot.camera.height)
    begins, ends = (FACES_PER_SOLID * caster.starts[each] for each in (slice(None, -1), slice(1, None)))
    own = np.array([(block.i, block.j) == (shot.i, shot.j) for block in blocks])
    shown = np.zeros(sight.surfaces.shape, np.bool_)
    for begin, end in zip(begins[own], ends[own], strict=True):
        shown |= (begin <= sight.surfaces) & (sight.surfaces < end)
    x, y, z = sight.directions
    with np.errstate(divide="ignore", invalid="ignore"):
        i, j = ((caster.position[k] - of / z * caster.position[2]) // BLOCK_METRES for k, of in enumerate((x, y)))
    shown |= (sight.surfaces == GROUND_FACE) & (i == shot.i) & (j == shot.j)
    return np.asarray(shown.all(axis=0))


def disturbed(scene: Scene, degrees: float, percent: float, seed: int) -> Scene:
    """The scene with its training poses, except the two fixed ones, turned by `degrees` and shifted by `percent` of the
    extent."""
    rng = np.random.default_rng(seed)
    train = [view.name for view in scene.train_views]
    held = {train[index] for index in Poses(TrainConfig(refine_poses=True), scene.train_views, scene.extent).held}

    def off(view: View) -> View:
        axis, direction = (each / np.linalg.norm(each) for each in rng.standard_normal((2, 3)))
        if view.name not in train or view.name in held:
            return view
        motion = np.concatenate([np.radians(degrees) * axis, percent / 100 * scene.extent * direction])
        return replace(view, camera=view.camera.moved(motion))

    return replace(scene, views=[off(view) for view in scene.views])


def refocused(scene: Scene, part: float) -> Scene:
    """The scene with focal lengths and horizontal principal points changed by this fraction of the focal length."""
    change = (part, part, 0.0)
    views = [
        replace(view, camera=view.camera.refocused(*change), lens=view.lens.refocused(*change)) for view in scene.views
    ]
    return replace(scene, views=views)


@dataclass(frozen=True)
class Changes:
    """Changes of photographs: a gain and mixes (6,) for each, and the octaves of light lost in corners."""

    gains: Float64
    mixes: Float64
    corners: float

    def on(self, place: int, view: View, pixels: Image) -> Image:
        """The changed photograph number `place`, from the pixels of `view`."""
        changed: Image = pixels * np.float32(self.gains[place])
        if self.mixes.any():
            changed = changed @ np.linalg.inv(unmixing(self.mixes[place])).T
        if self.corners:
            camera = view.camera
            s = spread(camera.width, camera.height, (camera.cx, camera.cy))[:, :, None]
            changed = changed * light(np.array([-self.corners / 2, -self.corners / 2, 0]), s)
        return np.ascontiguousarray(changed, np.float32)

    @property
    def label(self) -> str:
        """Part of a folder's name that names the changes other than gains."""
        most = f"-mixes-{np.abs(self.mixes).max():.4f}" if self.mixes.any() else ""
        return most + (f"-corners-{self.corners:g}" if self.corners else "")

    @property
    def none(self) -> Changes:
        """No changes."""
        return Changes(np.ones_like(self.gains), np.zeros_like(self.mixes), 0.0)


def changed(scene: Scene, folder: Path, changes: Changes) -> Scene:
    """The scene with changed photographs, written as EXR files in their working size."""
    folder.mkdir(parents=True, exist_ok=True)
    views: list[View] = []
    for view in scene.views:
        if not view.lens.is_pinhole:
            raise InputError(f"{view.name}: taken through a lens that distorts, expected a scene of pinhole cameras")
        path = folder / f"{len(views):04d}.exr"
        if not path.exists():
            write_image(path, changes.on(len(views), view, composite(view.load(), (0, 0, 0))))
        lens = replace(view.lens, width=view.camera.width, height=view.camera.height)  # the size of the written file
        views.append(replace(view, path=path, lens=lens).stamped())
    return replace(scene, views=views)


def write_strip(path: Path, pictures: Sequence[Float32], axis: int = 1) -> None:
    """Write several pictures as one file, side by side or below each other."""
    write_image(path, np.clip(np.concatenate(pictures, axis=axis), 0, 1).astype(np.float32))
