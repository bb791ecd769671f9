# SPDX-License-Identifier: Apache-2.0
"""Photographs in main memory: decoded once, bounded, cached, read ahead, and the same training in any case."""

from __future__ import annotations

import re
import shutil
from collections import Counter
from collections.abc import Callable
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import Capture
from compare import assert_same_bits
from same_bytes import gone_on, model_bytes, stopped
from tiny import short, write_scene

from clsplat.api import train
from clsplat.camera import Camera
from clsplat.cli.main import main
from clsplat.config.masks import MaskUse
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.device.memory_account import Memory
from clsplat.device.profile import Calls
from clsplat.errors import InputError
from clsplat.images.reading import read_image
from clsplat.images.writing import write_image
from clsplat.runs.run import Run
from clsplat.runs.settings import parse_config
from clsplat.scenes import scene as scenes
from clsplat.scenes.analysis import sanity_checks
from clsplat.scenes.dataset import Lens
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene, View
from clsplat.training.memory import HostMemory
from clsplat.training.memory import model_bytes as bytes_of_a_gaussian
from clsplat.training.supervision import host_photographs
from clsplat.training.supervision.decoded_store import DecodedStore
from clsplat.training.supervision.decoding import Decoder, PhotographError, stored
from clsplat.training.supervision.host_photographs import HostPhotographs
from clsplat.training.trainer import Trainer

CONFIG = short(iterations=12, warmup=(2, 5), report=False, density={"every": 0})
"""A short training at three sizes."""
FACTORS = (4.0, 2.0, 1.0)


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Number of times that each photograph is decoded."""
    counts: Counter[str] = Counter()
    plain = scenes.read_image

    def read_image(path: Path, **options: Any) -> Any:
        counts[path.name] += 1
        return plain(path, **options)

    monkeypatch.setattr(scenes, "read_image", read_image)
    return counts


@pytest.fixture
def own(scene: Scene, tmp_path: Path) -> Path:
    """Folder of the tiny scene, to be changed."""
    assert scene.source is not None
    folder = scene.views[0].path.parent.parent
    return Path(shutil.copytree(folder, tmp_path / "own"))


def as_before(view: View, width: int, height: int) -> Any:
    """A view's pixels as versions before this one stored them."""
    image = view.load_masked(width, height)
    levels = np.rint(image * 255)
    exact = np.array_equal(levels * np.float32(1 / 255), image) and 0 <= levels.min() <= levels.max() <= 255
    return levels.astype(np.uint8) if exact else image


def wanted(scene: Scene, factor: float) -> list[Any]:
    views = scene.require_training_views()
    return [as_before(v, max(int(v.camera.width / factor), 1), max(int(v.camera.height / factor), 1)) for v in views]


def masked(folder: Path) -> Scene:
    """The scene with alpha, and a mask for each photograph."""
    scene = write_scene(folder, alpha=True)
    (scene / "masks").mkdir()
    rng = np.random.default_rng(4)
    for path in (scene / "images").iterdir():
        write_image(
            scene / "masks" / path.name, np.repeat(rng.integers(0, 2, (40, 48, 1)), 3, axis=2).astype(np.float32)
        )
    return load_scene(scene, masks=MaskUse("ignore", "blend", False))


# Sizes and values


def test_a_file_is_decoded_once_for_all_sizes(
    scene: Scene, default_device: Device, decoded: Counter[str], tmp_path: Path
) -> None:
    for memory, most in ((HostMemory(), 1), (HostMemory(None, tmp_path), 1), (HostMemory(None, tmp_path), 0)):
        decoded.clear()
        trainer = Trainer(scene, CONFIG, default_device, memory=memory)
        for _ in range(CONFIG.iterations):
            trainer.train_step()
        trainer.close()
        assert set(decoded.values()) <= {most}, memory
        assert len(decoded) == most * len(scene.train_views)


@pytest.mark.parametrize("kind", ["plain", "masked"])
def test_exact_pixels_are_those_of_each_size(scene: Scene, tmp_path: Path, kind: str) -> None:
    if kind == "masked":
        scene = masked(tmp_path / "masked")
    host = HostPhotographs(Decoder(scene.train_views, factors=FACTORS))
    for factor in FACTORS:
        for index, image in enumerate(wanted(scene, factor)):
            found = host.get(index, factor)
            assert found.dtype == image.dtype
            assert_same_bits(found, image, f"{index} at {factor}")
    assert not any(factor > 1 for _, factor in host._held), "sizes that are past are dropped"


@pytest.mark.parametrize("kind", ["plain", "masked"])
def test_8_bit_pixels_are_rounded(scene: Scene, tmp_path: Path, kind: str) -> None:
    if kind == "masked":
        scene = masked(tmp_path / "masked")
    views = scene.train_views
    host = HostPhotographs(Decoder(views, rounds=True, factors=FACTORS))
    for factor in FACTORS:
        for index, image in enumerate(wanted(scene, factor)):
            found = host.get(index, factor)
            assert found.dtype == np.uint8
            exact = image if image.dtype == np.float32 else image * np.float32(1 / 255)
            assert np.abs(found / 255 - exact).max() <= 0.5 / 255 + 1e-5


def test_values_beyond_1_stay_as_they_are() -> None:
    image = np.full((3, 4, 3), 0.3, np.float32)
    assert stored(image, rounds=True).dtype == np.uint8
    assert stored(image, rounds=False).dtype == np.float32
    for value in (1.5, -0.25):
        image[1, 2, 0] = value
        assert_same_bits(stored(image, rounds=True), image, "as it was")


def test_8_bits_follow_the_number_of_photographs() -> None:
    auto = TrainConfig()
    assert [auto.rounds_photos(count) for count in (1, 299, 300, 10**5)] == [False, False, True, True]
    assert not replace(auto, photos="exact").rounds_photos(10**5)
    assert replace(auto, photos="8bit").rounds_photos(1)
    with pytest.raises(InputError, match=r"--photos half: expected one of auto, exact, 8bit"):
        replace(auto, photos="half").check()  # type: ignore[arg-type]


def test_runs_of_earlier_versions_are_exact() -> None:
    config, _ = parse_config("clsplat = '0'\n[train]\niterations = 7\ntest_every = 8\n", Path("config.toml"))
    assert config.photos == "exact"


# Memory


class Files:
    """Views of made pixels, as a decoder of them, which counts what is decoded."""

    def __init__(self, count: int, pixels: int = 100) -> None:
        self.count, self.shape, self.store, self.calls = count, (pixels, 1, 1), None, Counter[int]()

    def largest(self) -> int:
        return self.shape[0]

    def working(self) -> int:
        return 0

    def pixels(self, index: int, factor: float, *, keeps: bool) -> dict[float, Any]:  # noqa: ARG002
        self.calls[index] += 1
        return {factor: np.full(self.shape, index, np.uint8)}


def bounded(files: Files, photographs: int, threads: int, monkeypatch: pytest.MonkeyPatch) -> HostPhotographs:
    monkeypatch.setattr(host_photographs, "reading_threads", lambda: threads)
    host = HostPhotographs(files)  # type: ignore[arg-type]
    host.follow(100 * photographs)
    return host


@pytest.mark.parametrize("threads", [1, 2, 8])
def test_memory_holds_and_every_view_is_right(monkeypatch: pytest.MonkeyPatch, threads: int) -> None:
    files, rng = Files(40), np.random.default_rng(2)
    host = bounded(files, 12, threads, monkeypatch)
    most = 0
    for _ in range(6):
        queue = rng.permutation(files.count).tolist()
        while queue:
            index = queue.pop()
            assert (host.get(index, 1.0) == index).all()
            host.read_ahead([(each, 1.0) for each in queue[::-1][:8]])
            with host._lock:
                most = max(most, host._bytes)
                assert host._bytes == sum(image.nbytes for image in host._held.values())
    host.close()
    assert most <= 1200
    assert sum(files.calls.values()) < 6 * files.count, "some stay from pass to pass"


def test_the_least_holds_what_a_step_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    files = Files(10)
    host = bounded(files, 0, 1, monkeypatch)
    for index in range(10):
        assert (host.get(index, 1.0) == index).all()
        host.read_ahead([(each, 1.0) for each in range(index + 1, 10)])
    host.close()
    assert host._bytes <= host.least


def test_an_error_comes_with_the_view_that_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    files, broken = Files(4), [True]

    def pixels(index: int, factor: float, *, keeps: bool) -> dict[float, Any]:
        if index == 2 and broken[0]:
            raise PhotographError("2 does not decode")
        return Files.pixels(files, index, factor, keeps=keeps)

    monkeypatch.setattr(files, "pixels", pixels)
    host = bounded(files, 12, 2, monkeypatch)
    host.read_ahead([(index, 1.0) for index in range(4)])
    for index in (0, 1, 3):
        assert (host.get(index, 1.0) == index).all()
    for _ in range(2):
        with pytest.raises(PhotographError, match="2 does not decode"):
            host.get(2, 1.0)
    broken[0] = False
    assert (host.get(2, 1.0) == 2).all()
    host.close()
    host.read_ahead([(0, 1.0)])
    assert (host.get(3, 1.0) == 3).all(), "also after the threads have ended"


def limit_of(scene: Scene, config: TrainConfig, device: Device) -> int:
    """The smallest limit with which a training begins, to the byte."""
    photographs = HostMemory().photographs(scene, config)
    least = photographs.least + len(scene.points) * bytes_of_a_gaussian(config) * device.shares_memory
    HostMemory(least).check(scene, config, device)
    with pytest.raises(InputError, match=r"expected at least \d+MiB"):
        HostMemory(least - 1).check(scene, config, device)
    return least


WAYS = ("memory", "limit", "limit, no cache", "cache", "one thread")


@pytest.fixture(scope="module")
def unbounded(scene: Scene, default_device: Device, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return model_bytes(scene, CONFIG, default_device, tmp_path_factory.mktemp("unbounded"))


@pytest.mark.parametrize(
    "way", [pytest.param(way, marks=[] if way == "limit" else pytest.mark.slow) for way in WAYS[1:]]
)
def test_training_is_the_same(
    scene: Scene,
    default_device: Device,
    tmp_path: Path,
    unbounded: bytes,
    monkeypatch: pytest.MonkeyPatch,
    decoded: Counter[str],
    way: str,
) -> None:
    options: dict[str, Any] = {"cache": tmp_path / "cache"}
    if way != "cache":
        options = {"max_host_mem": limit_of(scene, CONFIG, default_device)}
    if way == "limit, no cache":
        options["cache"] = "none"
    if way == "one thread":
        monkeypatch.setattr(host_photographs, "reading_threads", lambda: 1)
    assert model_bytes(scene, CONFIG, default_device, tmp_path / "run", **options) == unbounded
    assert not (tmp_path / "run" / "cache").exists(), "the run's own cache is removed"
    if way.startswith("limit"):
        assert (max(decoded.values()) > 2) == (way == "limit, no cache"), "the sanity checks and the training decode"
    assert len(list(tmp_path.glob("cache/*.pixels"))) >= (len(scene.train_views) if way == "cache" else 0)
    if way == "cache":  # all are read from it, one damaged one and a cut one are not
        first, second, *_ = sorted((tmp_path / "cache").iterdir())
        first.write_bytes(first.read_bytes()[:-1] + b"?")
        second.write_bytes(b"")
        with pytest.warns(UserWarning, match="the photograph is decoded again") as told:
            assert model_bytes(scene, CONFIG, default_device, tmp_path / "again", **options) == unbounded
        assert len([each for each in told if "is decoded again" in str(each.message)]) == 1


@pytest.mark.slow
@pytest.mark.parametrize("memory", ["ample", "little"])
def test_a_device_with_memory_of_its_own_is_the_same(
    scene: Scene, default_device: Device, tmp_path: Path, unbounded: bytes, memory: str
) -> None:
    """With all photographs on the device, and with some sent in each step."""
    apart = copy(default_device)
    apart.shares_memory, apart.under_way, apart.calls = False, [], Calls()
    apart.memory = Memory(None if memory == "ample" else 600 * 1024)
    limit = limit_of(scene, CONFIG, apart)
    assert model_bytes(scene, CONFIG, apart, tmp_path / "run", max_host_mem=limit) == unbounded


@pytest.mark.slow
def test_a_batch_is_the_same(scene: Scene, default_device: Device, tmp_path: Path) -> None:
    config = replace(CONFIG, batch=2)
    whole = model_bytes(scene, config, default_device, tmp_path / "whole")
    limit = limit_of(scene, config, default_device)
    assert model_bytes(scene, config, default_device, tmp_path / "limit", max_host_mem=limit) == whole


@pytest.mark.slow
def test_an_interrupted_run_goes_on_with_its_cache(
    scene: Scene, default_device: Device, tmp_path: Path, unbounded: bytes, decoded: Counter[str]
) -> None:
    run, limit = Run.create(tmp_path / "run", CONFIG), limit_of(scene, CONFIG, default_device)

    def stop(report: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(scene, CONFIG, device=default_device, run=run, on_step=stop, max_host_mem=limit)
    assert len(list(run.cache_path.glob("*.pixels"))) >= len(scene.train_views)
    decoded.clear()
    train(scene, CONFIG, device=default_device, run=run, resume=True, max_host_mem=limit)
    assert run.model_path.read_bytes() == unbounded
    assert max(decoded.values()) == 1, "by the sanity checks and the evaluation: all are in the cache"
    assert not run.cache_path.exists()
    assert stopped(1, scene, CONFIG, default_device, tmp_path / "other")["model.ply"].tobytes() == unbounded


def test_too_small_a_limit_is_refused_before_anything_is_written(own: Path, tmp_path: Path, capsys: Capture) -> None:
    line = ["train", str(own), "-o", str(tmp_path / "run"), "--iterations", "3", "--no-report"]
    assert main([*line, "--max-host-mem", "100KiB"]) == 2
    (said,) = [each for each in capsys.readouterr().err.splitlines() if each.startswith("clsplat: error: ")]
    assert re.search(r"--max-host-mem 100 KiB is too little: .*; expected at least \d+MiB$", said)
    assert main([*line, "--max-host-mem", "lots"]) == 2
    assert "--max-host-mem lots: expected a size" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert main([*line, "--cache", str(tmp_path / "file")]) == 2
    assert f"--cache {tmp_path / 'file'}: expected a folder, or none" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_more_gaussians_than_the_limit_has_room_for(scene: Scene, default_device: Device) -> None:
    memory = HostMemory(limit_of(scene, CONFIG, default_device))
    photographs = memory.photographs(scene, CONFIG)
    assert memory.share(photographs, 10**6, 2**40, begins=False) is False
    assert photographs.bounded
    with pytest.raises(InputError, match=r"1,000,000 Gaussians take 1,024.0 GiB of main memory"):
        memory.share(photographs, 10**6, 2**40, begins=True)


# Files that change


def removed(path: Path) -> None:
    path.unlink()


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:200])


def replaced(path: Path) -> None:
    write_image(path, np.full((40, 48, 3), 0.5, np.float32))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (removed, "could be read when the scene was loaded, but not now: there is no such file"),
        pytest.param(cut, "has been changed or replaced since the scene was loaded", marks=pytest.mark.slow),
        pytest.param(replaced, "has been changed or replaced since the scene was loaded", marks=pytest.mark.slow),
    ],
)
def test_a_photograph_that_changes_ends_the_run_with_a_checkpoint(
    own: Path,
    tmp_path: Path,
    default_device: Device,
    monkeypatch: pytest.MonkeyPatch,
    unbounded: bytes,
    change: Callable[[Path], None],
    said: str,
) -> None:
    monkeypatch.setattr(host_photographs, "reading_threads", lambda: 1)
    scene, run = load_scene(own), Run.create(tmp_path / "run", CONFIG)
    paths, saved = [], tmp_path / "saved.png"

    def between(trainer: Trainer, _stops: Callable[[], bool]) -> None:
        if trainer.step == 3 and not paths:
            paths.append(trainer.views[trainer.position.queue[0]].path)
            shutil.copy2(paths[0], saved)
            change(paths[0])

    with pytest.raises(InputError, match=f"{said}.*a checkpoint of step 7 is written: .*--resume") as caught:
        train(scene, CONFIG, device=default_device, run=run, between=between)
    assert str(paths[0]) in str(caught.value)
    assert caught.value.exit_status == 2
    paths[0].unlink(missing_ok=True)
    shutil.copy2(saved, paths[0])
    resumed = gone_on(load_scene(own), CONFIG, default_device, Run.create(run.path, CONFIG, resume=True))
    assert resumed["model.ply"].tobytes() == unbounded


# Large scenes


@pytest.fixture
def many(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scene is large from 4 training photographs on, and few of them are looked at."""
    monkeypatch.setattr(scenes, "MANY_PHOTOGRAPHS", 4)
    monkeypatch.setattr(scenes, "MAX_SAMPLED_PHOTOGRAPHS", 3)
    monkeypatch.setattr(sanity_checks, "MAX_CHECKED_VIEWS", 2)


@pytest.mark.usefixtures("many")
def test_photographs_of_large_scenes_are_decoded_later(
    own: Path, decoded: Counter[str], default_device: Device
) -> None:
    scene = load_scene(own)
    scene.check_pictures()
    assert decoded == {}
    assert len(scene.digests) == len(scene.views)
    assert list(scene.thumbnails) == [view.name for view in scene.sampled_views]
    assert len(scene.sampled_views) == len(decoded) == 3
    assert all(view.split == "train" for view in scene.sampled_views)
    trainer = Trainer(scene, CONFIG, default_device)
    decoded.clear()
    trainer.train_step()
    trainer.close()
    assert len(decoded) < len(scene.train_views), "the first steps do not wait for all"


@pytest.mark.usefixtures("many")
@pytest.mark.parametrize("name", ["04.png", "08.png"])
def test_a_damaged_photograph_of_a_large_scene(
    own: Path, tmp_path: Path, default_device: Device, capsys: Capture, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """It is not in the sample, and the sanity checks do not look at it. The second is held out, and evaluated."""
    monkeypatch.setattr(host_photographs, "reading_threads", lambda: 1)
    path = own / "images" / name
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2] + bytes(200) + data[len(data) // 2 + 200 :])
    line = ["train", str(own), "-o", str(tmp_path / "run"), "--iterations", "9", "--no-report", "--warmup", ""]
    line += ["--max-host-mem", "1GiB", "--cache", str(tmp_path / "my cache")]
    assert main(line) == 2
    errors = [each for each in capsys.readouterr().err.splitlines() if each.startswith("clsplat: error: ")]
    assert len(errors) == 1
    assert str(path) in errors[0]
    again = f"--max-host-mem 1GiB --cache '{tmp_path / 'my cache'}'"
    assert f"clsplat train -o {tmp_path / 'run'} --resume {again}" in errors[0]


def test_a_cache_of_other_photographs_gives_none_of_their_pixels(own: Path, scene: Scene, tmp_path: Path) -> None:
    """Of another scene with the same names, of photographs that were replaced, and of other sizes."""
    store = DecodedStore(tmp_path / "cache")

    def check(read: Scene) -> None:
        decoder = Decoder(read.train_views, factors=FACTORS, store=store)
        for index, image in enumerate(wanted(read, 2.0)):
            assert_same_bits(decoder.pixels(index, 2.0, keeps=False)[2.0], image, str(index))

    check(scene)
    for path in (own / "images").iterdir():
        write_image(path, 1 - read_image(path))
    check(load_scene(own))
    replaced(own / "images" / "03.png")
    check(load_scene(own))
    check(load_scene(own, resolution=40))
    assert store.notes() == []


def test_keys_follow_what_pixels_depend_on(scene: Scene, tmp_path: Path) -> None:
    """A change of any of it reads another file of the cache."""
    views, store = scene.train_views, DecodedStore(tmp_path)
    view = views[0]
    camera: Camera = view.camera
    lens: Lens = view.lens
    others = [
        replace(view, path=views[1].path),
        replace(view, stamps=((1, 2),)),
        replace(view, lens=replace(lens, params=(*lens.params[:-1], 1.5))),
        replace(view, camera=camera.resized(24, 20)),
        replace(view, upright=True),
        masked(tmp_path / "masked").train_views[0],
    ]
    decoders = [Decoder([each], store=store) for each in (view, *others)]
    keys = {decoder._key(0, factor) for decoder in (*decoders, replace(decoders[0], rounds=True)) for factor in FACTORS}
    assert len(keys) == 3 * (len(decoders) + 1)
