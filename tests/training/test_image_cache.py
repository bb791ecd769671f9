# SPDX-License-Identifier: Apache-2.0
"""Photographs on the device: as many as the plan has room for, and the same training with and without them."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from calls import raising
from compare import assert_same_arrays
from tiny import short, write_scene

from clsplat.api import train
from clsplat.device.buffers import DeviceArray, allocate
from clsplat.device.context import Device
from clsplat.device.memory_account import Memory
from clsplat.device.profile import Calls
from clsplat.device.upload_ring import UPLOAD_RING_SLOTS, UploadRing
from clsplat.errors import CapacityError
from clsplat.rendering.memory_plan import Need, plan
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.training.supervision import image_cache
from clsplat.training.supervision.decoding import Decoder
from clsplat.training.supervision.host_photographs import HostPhotographs
from clsplat.training.supervision.image_cache import ImageCache
from clsplat.training.trainer import Trainer

LONG = short(iterations=24, random_points=300, density={"max_gaussians": 1500, "gradient_threshold": 1e-4})
"""Rising resolution, and Gaussians that become more."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return load_scene(write_scene(tmp_path_factory.mktemp("tiny") / "scene", points=False))


def with_memory_of_its_own(device: Device, limit: int | None = None) -> Device:
    """The device, as if its memory were not the host's."""
    device = copy(device)
    device.shares_memory, device.memory = False, Memory(limit)
    device.calls, device.under_way = Calls(), []
    return device


def bytes_of(scene: Scene) -> int:
    return sum(3 * view.camera.width * view.camera.height for view in scene.require_training_views())


def test_they_go_up_once_and_stay(scene: Scene, device: Device) -> None:
    apart = with_memory_of_its_own(device)
    store = ImageCache(apart, HostPhotographs(Decoder(scene.require_training_views())))
    store.follow(bytes_of(scene))
    for _ in range(2):
        for index in range(len(scene.require_training_views())):
            image = store.bring(index, 1.0)
            assert isinstance(image, DeviceArray)
            assert image.dtype == np.uint8
            np.testing.assert_array_equal(image.get(), store.load(index, 1.0))
    assert apart.memory.used == bytes_of(scene)
    assert apart.calls.writes == len(scene.require_training_views())
    assert store.bring(0, 2.0).shape[0] == scene.require_training_views()[0].camera.height // 2
    assert apart.memory.used < bytes_of(scene) / 2, "those of the size before are gone"


def test_those_that_do_not_fit_stay_on_the_host(scene: Scene, default_device: Device) -> None:
    views = scene.require_training_views()
    device, some = with_memory_of_its_own(default_device), bytes_of(scene) // 2
    store = ImageCache(device, HostPhotographs(Decoder(views)))
    store.follow(some)
    kinds = [isinstance(store.bring(index, 1.0), DeviceArray) for index in range(len(views))]
    assert kinds == [index < len(views) // 2 for index in range(len(views))]
    assert device.memory.used <= some
    store.follow(some - 1)
    assert device.memory.used == 0, "the plan has less room now"
    store.follow(0)
    assert not isinstance(store.bring(0, 1.0), DeviceArray)


def test_a_device_that_has_less_than_it_says(
    scene: Scene, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = ImageCache(with_memory_of_its_own(default_device), HostPhotographs(Decoder(scene.require_training_views())))
    store.follow(2**30)
    monkeypatch.setattr(image_cache, "allocate", raising(CapacityError("no memory left")))
    assert not isinstance(store.bring(0, 1.0), DeviceArray)
    monkeypatch.setattr(image_cache, "allocate", allocate)
    assert not isinstance(store.bring(1, 1.0), DeviceArray), "no second trial"


def test_memory_that_is_the_host_s_takes_none(scene: Scene, device: Device) -> None:
    assert device.shares_memory == (device.kind == "cpu")
    store, used = ImageCache(device, HostPhotographs(Decoder(scene.require_training_views()))), device.memory.used
    image = store.bring(0, 1.0)
    if device.shares_memory:
        assert isinstance(image, DeviceArray)
        np.testing.assert_array_equal(image.get(), store.load(0, 1.0))
        assert device.memory.used == used


@pytest.mark.slow
def test_training_is_the_same_wherever_they_are(scene: Scene, device: Device) -> None:
    wanted = train(scene, LONG, device=device)
    free = with_memory_of_its_own(device)
    for limit in (None, 0.9, 0.5):
        apart = with_memory_of_its_own(device, limit and int(limit * free.memory.peak))
        if limit is None:
            apart = free
        got = train(scene, LONG, device=apart)
        assert_same_arrays(got.arrays(), wanted.arrays())
        assert apart.memory.limit is None or apart.memory.peak <= apart.memory.limit


def test_a_trainer_has_them_where_there_is_room(scene: Scene, default_device: Device) -> None:
    for limit, resident in ((None, True), (2**26, True), (600 * 1024, False)):
        trainer = Trainer(scene, LONG, with_memory_of_its_own(default_device, limit))
        trainer.train_step()
        assert (trainer.plan.photographs > 0) == resident
        assert isinstance(trainer.photographs.bring(0, 4.0), DeviceArray) == resident


# The plan

NEED = Need(10_000, 4 * 4 * 59, 4 * 45, 132, 40, 76, 2**31 // 36, 50 * 2**20, 2**20, 100 * 2**20)


def test_they_take_half_of_what_is_left() -> None:
    left = 60 * 2**20
    made = plan(NEED, NEED.total + NEED.moving + left, 2**31, 32)
    assert made.photographs == left // 2
    assert not made.tight
    assert plan(NEED, NEED.total + NEED.moving - 1, 2**31, 32).photographs == 0
    assert plan(NEED, 2**31, 2**31, 32).photographs == NEED.photographs


def test_they_take_nothing_from_anything_else() -> None:
    for mebibytes in range(60, 400, 7):
        made = plan(NEED, mebibytes * 2**20, 2**31, 32)
        without = plan(replace(NEED, photographs=0), mebibytes * 2**20, 2**31, 32)
        assert (made.pieces, made.gathers, made.rows) == (without.pieces, without.gathers, without.rows)
        assert abs((without.pairs - made.pairs) * NEED.pair - made.photographs) <= NEED.pair
        assert made.pairs >= min(without.pairs, NEED.pairs), "there is room for the guess"


def test_those_that_do_not_fit_are_sent_ahead(scene: Scene, default_device: Device) -> None:
    """From room that the last ones give up; never more than allowed."""
    views = scene.require_training_views()
    device, some = with_memory_of_its_own(default_device), bytes_of(scene) // len(views) * (UPLOAD_RING_SLOTS + 1)
    store = ImageCache(device, HostPhotographs(Decoder(views)))
    store.follow(some)
    for index in range(len(views)):
        store.bring(index, 1.0)
    for index in (*range(len(views)), *range(len(views))):
        store.ahead(index, 1.0)
        image = store.bring(index, 1.0)
        assert isinstance(image, DeviceArray)
        np.testing.assert_array_equal(image.get(), store.load(index, 1.0))
        assert device.memory.used <= some
    store.ahead(0, 2.0)
    assert device.memory.used <= some, "at another size it begins anew"
    tight = ImageCache(with_memory_of_its_own(default_device), HostPhotographs(Decoder(views)))
    tight.follow(some // 2)
    for index in range(len(views) // 2):
        tight.bring(index, 1.0)
    tight.ahead(len(views) - 1, 1.0)
    assert not isinstance(tight.bring(len(views) - 1, 1.0), DeviceArray), "too little for them"


@pytest.mark.parametrize("by_capacity", ["0", "1"])
def test_training_is_the_same_with_those_that_are_sent_ahead(
    scene: Scene, default_device: Device, monkeypatch: pytest.MonkeyPatch, by_capacity: str
) -> None:
    wanted = train(scene, LONG, device=default_device)
    most = bytes_of(scene) // len(scene.require_training_views()) * UPLOAD_RING_SLOTS
    follow, taken = ImageCache.follow, []

    def take(uploads: UploadRing, key: object) -> DeviceArray | None:
        found = plain(uploads, key)
        taken.append(found is not None)
        return found

    plain = UploadRing.take
    monkeypatch.setattr(UploadRing, "take", take)
    monkeypatch.setattr(ImageCache, "follow", lambda store, allowed: follow(store, min(allowed, most)))
    monkeypatch.setenv("CLSPLAT_BY_CAPACITY", by_capacity)
    got = train(scene, LONG, device=with_memory_of_its_own(default_device))
    assert sum(taken) > LONG.iterations / 3
    assert_same_arrays(got.arrays(), wanted.arrays())
