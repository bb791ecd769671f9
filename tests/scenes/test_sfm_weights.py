# SPDX-License-Identifier: Apache-2.0
"""Learned features: weights that are given, wrong, published and never answered."""

from __future__ import annotations

import hashlib
import socket
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import onnx_files
import pycolmap
import pytest
from calls import refuses, warned, warnings_of
from compare import similarity
from demo_photographs import photographs
from pictures import write_pixels

from clsplat.config.masks import MaskUse
from clsplat.errors import InputError
from clsplat.scenes.sfm import reconstruct as sfm
from clsplat.scenes.sfm import weights
from clsplat.scenes.sfm.pipeline.aliked import AlikedNetwork, mutual_matches

COUNT = 8
LEARNED = sfm.SfmSettings(features="aliked", camera_model="SIMPLE_PINHOLE")
PROXIES = ("http_proxy", "https_proxy", "all_proxy", "no_proxy")


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(weights, "find_spec", lambda _: object())
    for name in PROXIES:
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.upper(), raising=False)
    return tmp_path / "cache/clsplat/weights"


@pytest.fixture
def silent(monkeypatch):
    """A proxy that takes connections and never answers."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        for name in ("http_proxy", "https_proxy"):
            monkeypatch.setenv(name, f"http://127.0.0.1:{server.getsockname()[1]}")
        monkeypatch.setattr(weights, "WEIGHTS_FETCH_SECONDS", 0.2)
        yield


@pytest.fixture
def served(monkeypatch):
    """A server of weights, and what it was asked for. `answer` is what it gives."""

    class Server(ThreadingHTTPServer):
        answer, asked = b"the network", 0

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.server.asked += 1
            self.send_response(200)
            self.send_header("Content-Length", str(len(self.server.answer)))
            self.end_headers()
            self.wfile.write(self.server.answer)

        def log_message(self, *_):
            pass

    with Server(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        published = weights.PublishedWeights(
            f"http://127.0.0.1:{server.server_port}/a.onnx", hashlib.sha256(b"the network").hexdigest()
        )
        monkeypatch.setitem(weights.WEIGHTS_BY_NAME, "aliked-n16rot", published)
        yield server
        server.shutdown()


def test_published_weights_are_fetched_once(served, cache):
    for _ in range(2):
        path = weights.learned_weights(None)
        assert path == cache / "aliked-n16rot.onnx"
        assert path.read_bytes() == b"the network"
    assert served.asked == 1
    path.write_bytes(b"damaged")
    assert weights.learned_weights("aliked-n16rot").read_bytes() == b"the network"


def test_another_file_than_was_published_is_not_kept(served, cache):
    served.answer = b"<html>please log in"
    found = warned(r"aliked-n16rot cannot be fetched .*the answer of 19 bytes is not the file: its SHA-256 differs",
                   weights.learned_weights, None)  # fmt: skip
    assert found is None
    assert not cache.exists()


def test_a_proxy_that_never_answers(silent):
    told = r"aliked-n32 cannot be fetched .*no complete answer within 0\.2 s\); SIFT features are used instead"
    assert warned(told, weights.learned_weights, "aliked-n32") is None


def test_an_answer_that_never_ends(served, monkeypatch):
    monkeypatch.setattr(weights, "WEIGHTS_FETCH_SECONDS", 0.2)
    ends = threading.Event()
    monkeypatch.setattr(weights.urllib.request, "build_opener", ends.wait)  # as a name server
    assert warned("no complete answer within", weights.learned_weights, None) is None
    ends.set()


def test_no_connection(monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as server:
        monkeypatch.setenv("https_proxy", f"http://127.0.0.1:{server.getsockname()[1]}")
    assert warned("Connection refused|actively refused", weights.learned_weights, None) is None  # the server is closed


def test_weights_that_are_not_there(tmp_path):
    refuses(r"--weights .*w\.onnx: no such file, expected an ONNX file, or the name aliked-n16rot or aliked-n32",
            weights.learned_weights, str(tmp_path / "w.onnx"))  # fmt: skip


def test_without_onnxruntime(monkeypatch):
    monkeypatch.setattr(weights, "find_spec", lambda _: None)
    refuses(r"--features aliked: needs onnxruntime, .* pip install 'clsplat\[learned\]'", weights.learned_weights, None)


def test_each_others_nearest():
    one = np.eye(4, dtype=np.float32)
    two = np.eye(4, dtype=np.float32)[[2, 0, 0]]
    assert mutual_matches(one, two).tolist() == [[0, 1], [2, 0]]
    assert mutual_matches(one, two[:0]).shape == mutual_matches(one[:0], two).shape == (0, 2)
    assert not len(mutual_matches(one, np.roll(one, 1, axis=1) * 0.1))


@pytest.fixture(scope="module")
def pictures():
    return photographs(range(COUNT), 240, 180)


def write_photos(pictures, folder):
    for index, picture in enumerate(pictures):
        write_pixels(folder / f"{index}.png", picture)
    return folder


@pytest.fixture
def noise(tmp_path):
    return write_photos(np.random.default_rng(0).integers(0, 255, (COUNT, 32, 64, 3), np.uint8), tmp_path / "photos")


def test_a_scene_without_learned_weights_is_one_of_sift(noise, silent, tmp_path, monkeypatch):
    tasks = []

    def run(task, work, report):
        tasks.append(task)
        (work / "result" / "images").mkdir(parents=True)
        return {"result": {"registered": [f"{index}.png" for index in range(COUNT)], "fragments": []}}

    monkeypatch.setattr(sfm, "run_worker", run)
    monkeypatch.setattr(sfm, "turn_new", lambda *_: None)
    (message,) = warnings_of(lambda: sfm.reconstruct(noise, tmp_path / "scene", LEARNED))
    assert "SIFT features are used instead" in message
    assert (tasks[0]["features"], tasks[0]["weights"]) == ("sift", "")


@pytest.mark.needs("onnxruntime")
@pytest.mark.parametrize(
    ("write", "told"),
    [
        (lambda path: path.write_bytes(b"hello"), "is not an ONNX network"),
        (lambda path: path.write_bytes(b""), "is not an ONNX network"),
        (onnx_files.write_other_network, "with the inputs a and the outputs b, expected image, max_keypoints, min"),
        (lambda path: onnx_files.write_corners(path, broken=True), "cannot be run on a photograph"),
    ],
)
def test_wrong_weights_are_named(write, told, noise, tmp_path):
    write(tmp_path / "w.onnx")
    settings = sfm.SfmSettings(features="aliked", weights=str(tmp_path / "w.onnx"))
    with pytest.raises(InputError, match=rf"w\.onnx: .*{told}"):
        sfm.reconstruct(noise, tmp_path / "scene", settings)
    assert {path.name for path in tmp_path.iterdir()} <= {"photos", "w.onnx", "cache"}


@pytest.mark.needs("onnxruntime")
@pytest.mark.parametrize("size", [(64, 96), (50, 70), (1, 33)])
def test_keypoints_are_in_the_pixels_of_the_picture(size, tmp_path):
    """A white pixel on black is found at its centre, at half a pixel more than its index."""
    onnx_files.write_corners(tmp_path / "w.onnx")
    picture = np.zeros((*size, 3), np.uint8)
    picture[size[0] // 2, 20] = 255
    points, rows = AlikedNetwork(tmp_path / "w.onnx").features(picture, 1)
    # the network's float32 positions are of 96 pixels at most, so they are within 1e-5 of a pixel
    assert points[0] == pytest.approx([20.5, size[0] // 2 + 0.5], abs=1e-4)
    assert np.linalg.norm(rows, axis=1) == pytest.approx(1, abs=1e-5)  # of float32


@pytest.mark.needs("onnxruntime")
@pytest.mark.slow
def test_cameras_from_given_weights(pictures, tmp_path):
    photos = write_photos(pictures[0], tmp_path / "photos")
    onnx_files.write_corners(tmp_path / "w.onnx")
    settings = sfm.SfmSettings(features="aliked", weights=str(tmp_path / "w.onnx"), camera_model="SIMPLE_PINHOLE")
    heard = []
    scenes = [
        sfm.reconstruct(photos, tmp_path / name, settings, threads=threads, progress=lambda *said: heard.append(said))
        for name, threads in (("one", 1), ("two", 3))
    ]
    model = pycolmap.Reconstruction(scenes[0] / "sparse/0")
    images = sorted((model.images[image] for image in model.reg_image_ids()), key=lambda image: image.name)
    assert len(images) == COUNT
    found, true = (np.stack(each) for each in (
        [image.projection_center() for image in images], [camera.position for camera in pictures[1]]
    ))  # fmt: skip
    scale, rotation, translation = similarity(found, true)
    errors = np.linalg.norm(scale * found @ rotation.T + translation - true, axis=1)
    assert errors.max() < 0.1  # metres, of 2.5 to the middle: ten pixels, as keypoints are whole pixels here
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        assert len({(scene / "sparse/0" / name).read_bytes() for scene in scenes}) == 1, name
    assert ("finding features", 1.0) in heard
    assert ("matching photos", 1.0) in heard


@pytest.mark.needs("onnxruntime")
@pytest.mark.slow
def test_no_learned_features_under_masks(pictures, tmp_path):
    photos = write_photos(pictures[0], tmp_path / "photos")
    onnx_files.write_corners(tmp_path / "w.onnx")
    mask = np.full((180, 240, 3), 255, np.uint8)
    mask[:60] = 0
    for index in range(COUNT):
        write_pixels(tmp_path / f"masks/{index}.png", mask)
    settings = sfm.SfmSettings(features="aliked", weights=str(tmp_path / "w.onnx"), camera_model="SIMPLE_PINHOLE")
    scene = sfm.reconstruct(photos, tmp_path / "scene", settings, masks=MaskUse("ignore"))
    model = pycolmap.Reconstruction(scene / "sparse/0")
    assert min(point.xy[1] for image in model.images.values() for point in image.points2D) >= 60
