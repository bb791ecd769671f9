# SPDX-License-Identifier: Apache-2.0
"""The readers of files from other people, a valid file for each, and ways to spoil it; see `stress_files.py`."""

from __future__ import annotations

import json
import os
import random
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from hostile_meshes import make_obj, make_usd_mesh, read_volume
from hostile_photographs import CAMERA_WRITERS, HAS_CAMERA_DECODERS, make_camera_image
from hostile_surveys import SURVEYS, XMP_NAMES, make_georeference, make_xmp, read_place
from hostile_videos import make_frames, make_video, read_frames, read_video
from ksplats import ksplat
from models import random_gaussians
from other_pictures import KINDS, other_picture
from pictures import write_pixels
from spoilers import MOST_BYTES, SPOILERS, spoil_place

from clsplat.camera import Camera
from clsplat.config.training import TrainConfig
from clsplat.gaussians import group_shapes
from clsplat.images.reading import image_size, read_image
from clsplat.images.writing import write_image
from clsplat.models import formats
from clsplat.models.formats import ply
from clsplat.models.info import model_info
from clsplat.runs import run as runs_run
from clsplat.runs import settings as runs_settings
from clsplat.runs.checkpoints import write_checkpoint
from clsplat.scenes import point_files
from clsplat.scenes.loading import load_scene
from clsplat.scenes.readers import colmap
from clsplat.scenes.sfm import photos as sfm_photos
from clsplat.scenes.sfm import reconstruct
from clsplat.scenes.video.frames import FRAME_TABLE_FILE
from clsplat.shots.read import choose_shot
from clsplat.training import repro_bundle


@dataclass(frozen=True)
class Reader:
    """A reader of files, with valid files for it and the ways to spoil them.

    make(folder): writes valid files.
    read(folder): reads them as clsplat does.
    files: the files that are spoilt.
    kinds: the ways to spoil them, keys of SPOILERS or "places".
    weight: the reader's share of the cases, relative to other readers.
    """

    name: str
    make: Callable[[Path], None]
    read: Callable[[Path], object]
    files: tuple[str, ...]
    kinds: tuple[str, ...]
    weight: float = 1.0


# Valid files


def make_ply(folder: Path, form: str = "binary_little_endian") -> None:
    """Write model.ply of 7 Gaussians, with SH of degree 1."""
    path = folder / "model.ply"
    ply.write(path, random_gaussians(7, 1))
    head, mark, body = path.read_bytes().partition(b"end_header\n")
    head = head.replace(b"binary_little_endian", form.encode())
    table = np.frombuffer(body, "<f4").reshape(7, -1)
    if form == "ascii":
        body = "".join(" ".join(map(repr, map(float, row))) + "\n" for row in table).encode()
    elif form == "binary_big_endian":
        body = table.astype(">f4").tobytes()
    path.write_bytes(head + mark + body)


def make_cloud(folder: Path, form: str) -> None:
    """Write cloud.ply, points with colours."""
    rows = [(0.1 * i, -0.2 * i, 1.0, 10 * i, 255 - i, 7) for i in range(9)]
    kinds = [("float", name) for name in "xyz"] + [("uchar", name) for name in ("red", "green", "blue")]
    lines = ["ply", f"format {form} 1.0", "element vertex 9"] + [f"property {kind} {name}" for kind, name in kinds]
    if form == "ascii":
        body = "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()
    else:
        body = b"".join(struct.pack("<3f3B", *row) for row in rows)
    (folder / "cloud.ply").write_bytes("\n".join([*lines, "end_header", ""]).encode() + body)


def make_model(folder: Path, name: str, **options: Any) -> None:
    """Write a model file in the format of its name. options: arguments of the format's writer."""
    formats.save(folder / name, random_gaussians(7, 1), **options)


def make_zip(folder: Path, name: str) -> None:
    """Write model.zip, which has a model of this name in a folder, compressed like a download."""
    with zipfile.ZipFile(folder / "model.zip", "w", zipfile.ZIP_DEFLATED) as archive, TemporaryDirectory() as made:
        make_model(Path(made), name)
        for file in sorted(Path(made).iterdir()):
            archive.write(file, f"model/{file.name}")
        archive.writestr("__MACOSX/model/._x.ply", b"x")


def make_ksplat(folder: Path) -> None:
    """Write model.ksplat of level 1: one section, a full bucket of 4 and two partial ones, SH of degree 1."""
    (folder / "model.ksplat").write_bytes(ksplat(random_gaussians(7, 1), 1, (7,), bucket=4)[0])


PICTURES = ("a.png", "b.png", "sub/c.png")


def _picture(path: Path, width: int = 12, height: int = 9, channels: int = 3) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, np.random.default_rng(1).random((height, width, channels)).astype(np.float32))


def make_colmap_text(folder: Path) -> None:
    """Write a COLMAP model as text, with its pictures."""
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    cameras = "# comment\n1 PINHOLE 12 9 11.5 11 6 4.5\n2 OPENCV 12 9 11.5 11 6 4.5 0.01 -0.002 0.001 0.0005\n"
    (sparse / "cameras.txt").write_text(cameras)
    seen = f"1.5 2.5 -1 {' '.join(f'3.5 {i}.5 {i + 1}' for i in range(6))}"
    lines = [
        f"{index + 1} 1 0 0 0 {0.1 * index} 0 {2 + index} {1 + index % 2} {name}\n{seen}\n"
        for index, name in enumerate(PICTURES)
    ]
    (sparse / "images.txt").write_text("".join(lines))
    points = "".join(f"{i + 1} {0.1 * i} 0.2 {3 + i} 10 200 30 0.5 1 {i + 1} 2 {i + 1} 3 {i + 1}\n" for i in range(6))
    (sparse / "points3D.txt").write_text(points)
    for name in PICTURES:
        _picture(folder / "images" / name)


def make_colmap_binary(folder: Path) -> None:
    """Write the COLMAP model of `make_colmap_text` in binary files, with its pictures."""
    import pycolmap

    make_colmap_text(folder)
    sparse = folder / "sparse" / "0"
    pycolmap.Reconstruction(sparse).write_binary(sparse)
    for path in sparse.glob("*.txt"):
        path.unlink()


def _frames(names: tuple[str, ...]) -> list[dict[str, Any]]:
    return [
        {"file_path": name, "transform_matrix": [[1, 0, 0, 0.1 * i], [0, 1, 0, 0], [0, 0, 1, 2.0 + i], [0, 0, 0, 1]]}
        for i, name in enumerate(names)
    ]


def make_transforms(folder: Path) -> None:
    """Write a transforms.json like nerfstudio's, with points, a split and keys of instant-ngp."""
    for name in PICTURES:
        _picture(folder / "images" / name)
    make_cloud(folder, "ascii")
    lens = {"fl_x": 11.5, "fl_y": 11.0, "cx": 6.0, "cy": 4.5, "w": 12, "h": 9, "k1": 0.01, "p1": 0.001}
    ours = {"aabb_scale": 4, "camera_model": "OPENCV", "ply_file_path": "cloud.ply", "scale": 0.33}
    frames = _frames(tuple(f"images/{name}" for name in PICTURES))
    document = {**lens, **ours, "offset": [0.5, 0.5, 0.5], "frames": frames, "test_filenames": ["images/a.png"]}
    (folder / "transforms.json").write_text(json.dumps(document, indent=1))


def make_blender(folder: Path) -> None:
    """Write Blender's transforms_train.json and transforms_test.json, with their pictures."""
    for split, names in (("train", ("a", "b")), ("test", ("c",))):
        for name in names:
            _picture(folder / split / f"{name}.png", channels=4)
        listed = {"camera_angle_x": 0.7, "frames": _frames(tuple(f"./{split}/{name}" for name in names))}
        (folder / f"transforms_{split}.json").write_text(json.dumps(listed))


def make_camera_keys(folder: Path) -> None:
    """Write a clsplat camera file of three keys, which have many of the properties of a key."""
    turn = [0.70710678, -0.70710678, 0, 0]
    keys: list[dict[str, Any]] = [
        {"frame": 1001, "position": [0, -4, 1], "world_from_cam": turn, "fov_x": 40},
        {"frame": 1009, "position": [2, -4, 1], "world_from_cam": turn, "fov_x": 55, "roll": 5},
        {"seconds": 0.5, "position": [3, -3, 1], "world_from_cam": [0.65, -0.65, 0.27, -0.27], "fx": 30},
    ]
    keys[-1]["shift"] = [0.05, 0]
    document: dict[str, Any] = {
        "clsplat_cameras": 1,
        "width": 32,
        "height": 18,
        "fps": 24,
        "first_frame": 1001,
        "near": 0.01,
    }
    document |= {"far": 100, "keys": keys}
    (folder / "cameras.json").write_text(json.dumps(document, indent=1))


def make_camera_path(folder: Path) -> None:
    """Write nerfstudio's camera_path.json with four frames."""
    poses = [[1, 0, 0, 0.1 * i, 0, 1, 0, 0.2, 0, 0, 1, 2.0 + i, 0, 0, 0, 1] for i in range(4)]
    frames = [{"camera_to_world": pose, "fov": 50, "aspect": 1.7} for pose in poses]
    document: dict[str, Any] = {"camera_type": "perspective", "render_width": 32, "render_height": 18, "fps": 24}
    document |= {"seconds": 4, "keyframes": [], "camera_path": frames}
    (folder / "camera_path.json").write_text(json.dumps(document, indent=1))


def make_cameras_json(folder: Path) -> None:
    """Write cameras.json with two cameras, as the 3DGS authors' code writes it in a training."""
    rows = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    lens = {"width": 24, "height": 18, "fy": 20.5, "fx": 20.5}
    cameras = [
        {"id": index, "img_name": f"{index:05d}", "position": [0.5, -2.0, index], "rotation": rows, **lens}
        for index in range(2)
    ]
    (folder / "cameras.json").write_text(json.dumps(cameras))


UNREAD = ("pcx",)
"""Kinds of `other_pictures.KINDS` that OpenImageIO does not open."""
FORMATS = ("png", "jpg", "exr", "tif", "bmp", "hdr", "tga", "ppm", "webp")


def make_image(folder: Path, extension: str) -> None:
    """Write a picture, with an EXIF orientation if the format supports it."""
    pixels = np.random.default_rng(2).random((19, 23, 3)).astype(np.float32)
    kind = "float" if extension in ("exr", "hdr") else "uint8"
    write_pixels(folder / f"picture.{extension}", pixels, kind, {"Orientation": 6})


def make_other_image(folder: Path, kind: str) -> None:
    """Write picture.png, which is a picture of another kind."""
    (folder / "picture.png").write_bytes(other_picture(kind))


def make_run(folder: Path) -> None:
    """Write a run with metrics, an evaluation, two checkpoints, and a model.ply of only one line."""
    run = runs_run.Run.create(folder / "run", TrainConfig(iterations=10))
    for step in (1, 2):
        run.append_metrics({"step": step, "loss": 0.1, "seconds": 0.5 * step})
        arrays = {"parameters/means": np.ones((4, 3), np.float32), "statistics/seen": np.zeros(4, np.float32)}
        state = {"rng": np.random.default_rng(0).bit_generator.state, "queue": [1, 2]}
        run.save_checkpoint(step, arrays, state)
    run.write_eval({"step": 2, "psnr": 20.0})
    (folder / "run" / "model.ply").write_bytes(b"ply\n")


def make_bundle(folder: Path) -> None:
    """Write the bundle of five Gaussians that a training leaves when it gives up."""
    shapes = group_shapes(5, 4)
    arrays: dict[str, Any] = {
        f"{kind}/{g}": np.ones(shapes[g], np.float32) for kind in ("parameters", "first", "second") for g in shapes
    }
    camera = Camera(12, 9, 11.5, 11.0, 6.0, 4.5, np.eye(3), np.zeros(3))
    record = {
        "stage": "adam",
        "rates": dict.fromkeys(shapes, 0.001),
        "camera": repro_bundle.recorded_camera(camera),
        "settings": runs_settings.config_text(TrainConfig(), None),
    }
    arrays |= {"photograph": np.zeros((9, 12, 3), np.uint8), "background": np.zeros(3, np.float32)}
    arrays |= {"rotation": camera.rotation, "translation": camera.translation}
    write_checkpoint(folder / "trouble-step-0000007.npz", 7, arrays, record)


def make_photos(folder: Path) -> None:
    """Write photos for structure from motion."""
    for name in ("a.png", "b.png"):
        _picture(folder / "photos" / name)
    make_image(folder / "photos", "jpg")


def make_record(folder: Path) -> None:
    """Write a result of structure from motion: the files that are checked before it is used again."""
    make_photos(folder)
    make_colmap_binary(folder)
    (folder / "sfm.json").write_text(json.dumps({"fingerprint": "0", "photos": 3, "unregistered": ["c.png"]}))


# Readers


def read_model(path: Path) -> None:
    """Read a model like `convert` and `info`."""
    model_info(path)
    formats.load(path).check()


def read_scene(folder: Path, file: str = "") -> None:
    """Read all parts of a scene that are read before training: cameras, points and pictures. file: its cameras."""
    scene = load_scene(folder / file)
    if bad := [warning for warning in scene.warnings if not warning.isprintable()]:
        raise AssertionError(f"a warning that is not a plain line: {bad[0][:300]!r}")
    scene.check_pictures()
    for view in scene.views:
        view.load()
        inside(folder, view.path)
    _ = scene.extent


def read_cameras(folder: Path, name: str) -> None:
    """Read a file's frames like `clsplat render --cameras`, and make a path around them."""
    path = folder / name
    shot = choose_shot(path, size=(32, 18))
    if all(camera.projection == "perspective" for camera in shot.cameras):
        choose_shot(path, path="turntable", count=5, size=(32, 18))
    if bad := [warning for warning in shot.warnings if not warning.isprintable()]:
        raise AssertionError(f"a warning that is not a plain line: {bad[0][:300]!r}")
    for camera in shot.cameras:
        numbers = (camera.rotation, camera.translation, [camera.fx, camera.fy, camera.cx, camera.cy, camera.near])
        if not all(np.isfinite(values).all() for values in numbers) or min(camera.fx, camera.fy) <= 0:
            raise AssertionError(f"a camera with invalid numbers, expected finite ones and fx, fy over 0: {camera}")


def inside(folder: Path, path: Path) -> None:
    """Raise AssertionError if the path of a scene's picture leads out of its folder.

    Links are not followed, since the folder's owner has made them.
    """
    if not Path(os.path.normpath(path)).is_relative_to(os.path.normpath(folder)):
        raise AssertionError(f"reads {path}, outside {folder}")


def read_picture(path: Path) -> None:
    """Read a picture's size and pixels."""
    image_size(path)
    image = read_image(path)
    if image.dtype != np.float32 or image.ndim != 3 or image.shape[2] not in (3, 4) or not np.isfinite(image).all():
        raise AssertionError(f"image {image.dtype} {image.shape}, expected finite float32 of 3 or 4 channels")


def read_run(folder: Path) -> None:
    """Read settings, metrics and evaluation of a run."""
    run = runs_run.Run.open(folder / "run")
    run.config.check()
    run.read_metrics()
    run.model_record()
    run.truncate_metrics(1)


def read_checkpoint(folder: Path) -> None:
    """Read the checkpoint from which a training continues."""
    path = folder / "run"
    checkpoint = runs_run.Run(path, TrainConfig(), None, resuming=True).load_latest_checkpoint()
    if checkpoint is not None:
        total = sum(array.nbytes for array in checkpoint.arrays.values())
        if total > MOST_BYTES:
            raise AssertionError(f"{total} bytes of arrays in a checkpoint, expected at most {MOST_BYTES}")


def read_photos(folder: Path) -> None:
    """Read photos like structure from motion, up to the start of pycolmap."""
    photos = sfm_photos.find_photos(folder / "photos")[0]
    sfm_photos.stage_photos(folder / "photos", photos, folder / "staged", lambda _: None, 1)


def read_record(folder: Path) -> None:
    """Check if a result of structure from motion can be used again."""
    reconstruct._is_finished(folder, folder / "photos", "0", overwrite=False)  # noqa: SLF001


BYTES = ("flip", "truncate", "numbers", "insert", "remove", "repeat", "append", "zeros", "swap")
LINES = ("words", "lines", "text")
PLACES = ("places",)
BINARY, TEXT = (*BYTES, *PLACES), (*BYTES, *LINES, *PLACES)
DOCUMENT, ARCHIVE = (*BYTES, *LINES, "json", *PLACES), (*BYTES, "archive", *PLACES)
SPARSE = tuple(f"sparse/0/{stem}" for stem in ("cameras", "images", "points3D"))
BINARY_FILES, TEXT_FILES = tuple(f"{name}.bin" for name in SPARSE), tuple(f"{name}.txt" for name in SPARSE)
CHECKPOINTS = tuple(f"run/checkpoints/step-000000{n}.npz" for n in (2, 1))
SOG_FILES = ("means_l.webp", "quats.webp", "sh0.webp", "shN_centroids.webp")
USD = ("usda", "usdc") if find_spec("pxr") else ()


def _model(folder: Path) -> None:
    colmap.read_model(folder / "sparse" / "0")
    colmap.read_cameras(folder)


def _one_file(
    name: str,
    file: str,
    make: Callable[[Path], None],
    read: Callable[[Path], object],
    kinds: tuple[str, ...],
    weight: float = 1.0,
) -> Reader:
    """A reader that takes the path of a single file."""
    return Reader(name, make, lambda folder: read(folder / file), (file,), kinds, weight)


def _saved(name: str, kinds: tuple[str, ...]) -> Reader:
    """A reader of a model file that clsplat writes."""
    return _one_file(f"model-{name}", name, partial(make_model, name=name), read_model, kinds, 2)


def _with_others(name: str, file: str, *others: str) -> Reader:
    """A reader of a model's JSON document that clsplat writes together with other files, `others`."""
    one = _one_file(name, file, partial(make_model, name=file), read_model, DOCUMENT, 3)
    return replace(one, files=(file, *others))


_ALL = (
    _one_file("ply", "model.ply", make_ply, ply.read, TEXT, 4),
    _one_file("ply-big", "model.ply", partial(make_ply, form="binary_big_endian"), ply.read, (*BYTES, *LINES)),
    _one_file("ply-ascii", "model.ply", partial(make_ply, form="ascii"), ply.read, (*BYTES, *LINES), 2),
    *(
        _one_file(
            f"cloud-{form[:6]}", "cloud.ply", partial(make_cloud, form=form), point_files.read_point_cloud, TEXT, 2
        )
        for form in ("ascii", "binary_little_endian")
    ),
    Reader("colmap-bin", make_colmap_binary, _model, BINARY_FILES, BINARY, 4),
    Reader("colmap-txt", make_colmap_text, _model, TEXT_FILES, TEXT, 4),
    Reader("scene-bin", make_colmap_binary, read_scene, BINARY_FILES, BYTES, 1),
    Reader("scene-txt", make_colmap_text, read_scene, TEXT_FILES, (*LINES, *PLACES), 1),
    Reader("scene-places", make_colmap_text, read_scene, tuple(f"images/{name}" for name in PICTURES), PLACES, 0.5),
    Reader("transforms", make_transforms, read_scene, ("transforms.json",), DOCUMENT, 4),
    Reader("blender", make_blender, read_scene, ("transforms_train.json", "transforms_test.json"), DOCUMENT, 2),
    *(Reader(name, make, partial(read_scene, file=file), (file,), DOCUMENT, 3) for name, make, file in SURVEYS),
    Reader("xmp", make_xmp, read_scene, XMP_NAMES, TEXT, 3),
    Reader("georeference", make_georeference, read_place, ("georeference.json",), DOCUMENT),
    *(
        Reader(f"cameras-{kind}", make, partial(read_cameras, name=name), (name,), DOCUMENT, 3)
        for kind, make, name in (
            ("keys", make_camera_keys, "cameras.json"),
            ("path", make_camera_path, "camera_path.json"),
            ("poses", make_transforms, "transforms.json"),
            ("inria", make_cameras_json, "cameras.json"),
        )
    ),
    *(
        _one_file(f"image-{each}", f"picture.{each}", partial(make_image, extension=each), read_picture, BYTES)
        for each in FORMATS
    ),
    *(
        _one_file(f"image-{each}", f"picture.{each}", partial(make_camera_image, extension=each), read_picture, BYTES)
        for each in (CAMERA_WRITERS if HAS_CAMERA_DECODERS else ())
    ),
    *(
        _one_file(f"other-{kind}", "picture.png", partial(make_other_image, kind=kind), read_picture, BYTES, 0.3)
        for kind in KINDS
        if kind not in UNREAD
    ),
    Reader("config", make_run, read_run, ("run/config.toml",), TEXT, 3),
    Reader("records", make_run, read_run, ("run/metrics.jsonl", "run/eval.json"), DOCUMENT, 3),
    Reader("checkpoint", make_run, read_checkpoint, CHECKPOINTS, ARCHIVE, 3),
    _one_file("bundle", "trouble-step-0000007.npz", make_bundle, repro_bundle.read_bundle, ARCHIVE, 2),
    Reader("photos", make_photos, read_photos, ("photos/a.png", "photos/picture.jpg"), BINARY, 1),
    Reader("record", make_record, read_record, ("sfm.json",), DOCUMENT, 1),
    *(
        Reader(name, make, read, (file,), kinds, 1)
        for name, make, read, file, kinds in (
            ("video", make_video, read_video, "walk.mp4", BINARY),
            ("frames", make_frames, read_frames, f"frames/{FRAME_TABLE_FILE}", DOCUMENT),
        )
        if find_spec("av")
    ),
    *(
        _saved(name, TEXT if name == "model.compressed.ply" else BINARY)
        for name in ("model.splat", "model.compressed.ply", "model.spz", "model.sog", "model.glb")
    ),
    *(_saved(f"model.{each}", TEXT) for each in USD),
    _one_file("model-spz-2", "model.spz", partial(make_model, name="model.spz", version=2), read_model, BINARY, 2),
    _with_others("gltf", "model.gltf", "model.bin"),
    _with_others("sog-folder", "meta.json", *SOG_FILES),
    _one_file("ksplat", "model.ksplat", make_ksplat, read_model, BINARY, 2),
    *(
        _one_file(f"zip-{name}", "model.zip", partial(make_zip, name=name), read_model, ARCHIVE, 1)
        for name in ("model.ply", "meta.json")
    ),
    _one_file("mesh-obj", "mesh.obj", make_obj, read_volume, TEXT, 2),
    *(
        _one_file(f"mesh-{each}", f"mesh.{each}", partial(make_usd_mesh, name=f"mesh.{each}"), read_volume, TEXT, 0.5)
        for each in USD
    ),
)
READERS = {reader.name: reader for reader in _ALL}


def spoil(reader: Reader, folder: Path, rng: random.Random) -> str:
    """Spoil files of the reader one to three times, and return a description of the changes."""
    said = []
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        path = folder / rng.choice(reader.files)
        kind = rng.choice(reader.kinds)
        if not path.is_file() or path.is_symlink() or path.stat().st_size > MOST_BYTES:
            continue
        said.append(f"{kind} of {path.relative_to(folder)}")
        if kind == "places":
            spoil_place(path, folder, rng)
            continue
        data = path.read_bytes()
        path.write_bytes(SPOILERS[kind](data, rng))
    return "; ".join(said)
