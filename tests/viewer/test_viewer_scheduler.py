# SPDX-License-Identifier: Apache-2.0
"""Whose picture is made next: viewers in turn, errors and jobs, and the share of a training."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest
from calls import noted
from looking import pose

from clsplat.errors import InputError
from clsplat.viewer.appearance import (
    Look,
)
from clsplat.viewer.refinement import (
    Level,
    Share,
)
from clsplat.viewer.scheduler import Viewer, Viewing


class FakeModel:
    """version and pixels as `Model` has them; what was asked for."""

    def __init__(self) -> None:
        self.version, self.pixels = 0, 10**7
        self.asked: list[tuple[int, int, Look, bool]] = []
        self.trouble: Exception | None = None

    def picture(self, camera: Any, look: Look, *, exact: bool) -> tuple[np.ndarray, str]:
        if self.trouble is not None:
            raise self.trouble
        self.asked.append((camera.width, camera.height, look, exact))
        return np.zeros((camera.height, camera.width, 3), np.uint8), "words"


class FakePage:
    viewer: Viewer

    def __init__(self) -> None:
        self.shown: list[Level] = []
        self.told: list[str] = []

    def show(self, _image: np.ndarray, level: Level, _text: str) -> None:
        self.shown.append(level)

    def tell(self, message: str) -> None:
        self.told.append(message)


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def viewing(*poses: float) -> tuple[Viewing, FakeModel, list[FakePage], Clock]:
    model, clock = FakeModel(), Clock()
    found, pages = Viewing(model, clock), [FakePage() for _ in poses]
    for page, x in zip(pages, poses, strict=True):
        page.viewer = found.join(page)
        found.moved(page.viewer, pose(x))
    return found, model, pages, clock


def test_each_sees_their_own_camera_in_turn() -> None:
    found, model, pages, clock = viewing(0.0, 1.0)
    assert found.work() and found.work()
    assert [len(page.shown) for page in pages] == [1, 1]
    assert not found.work()
    clock.now = 1.0
    found.moved(pages[0].viewer, pose(5.0))
    assert found.work() and found.work()
    assert pages[1].shown[-1].exact, "who moves does not keep the others from their exact picture"
    assert not pages[0].shown[-1].exact
    assert model.asked[-1][:2] != (0, 0)


def test_an_exact_picture_that_comes_too_late_is_not_called_exact() -> None:
    """The camera has moved while it was made: beside what moves nothing says exact."""
    found, model, (page,), clock = viewing(0.0)
    assert found.work()
    clock.now = 10.0
    picture = model.picture

    def slow(*arguments: Any, **options: Any) -> tuple[np.ndarray, str]:
        found.moved(page.viewer, pose(7.0))
        return picture(*arguments, **options)

    model.picture = slow  # type: ignore[method-assign]
    assert found.work()
    assert model.asked[-1][3], "it was made as an exact one"
    assert not page.shown[-1].exact
    model.picture = picture  # type: ignore[method-assign]
    assert found.work() and not page.shown[-1].exact
    clock.now = 20.0
    while found.work():
        pass
    assert page.shown[-1] == Level(1.0, exact=True)


def test_the_same_camera_once_more_is_no_news() -> None:
    found, _, pages, _ = viewing(0.0)
    found.work()
    found.moved(pages[0].viewer, pose(0.0))
    assert not found.work()
    found.moved(pages[0].viewer, pose(0.0, (320, 200)))
    assert found.work()
    assert len(pages[0].shown) == 2


def test_another_look_is_shown() -> None:
    found, model, pages, _ = viewing(0.0)
    found.work()
    found.looks(pages[0].viewer, Look("depth"))
    assert found.work()
    assert model.asked[-1][2] == Look("depth")
    found.looks(pages[0].viewer, Look("depth"))
    assert not found.work()


def test_an_exact_picture_is_no_larger_than_the_model_allows() -> None:
    found, model, _, clock = viewing(0.0)
    model.pixels = 10_000
    found.work()
    clock.now = 1.0
    found.work()
    width, height, _, exact = model.asked[-1]
    assert exact
    assert width * height <= 10_200  # rounded
    assert width / height == pytest.approx(16 / 9, rel=0.02)


def test_trouble_is_told_once_and_the_next_picture_is_tried() -> None:
    found, model, pages, clock = viewing(0.0)
    model.trouble = InputError("no room")
    found.work()
    clock.now = 1.0
    found.work()
    assert pages[0].told == ["no room"]
    assert not found.work(), "no second try of the same"
    model.trouble = None
    found.moved(pages[0].viewer, pose(2.0))
    found.work()
    assert len(pages[0].shown) == 1


def test_jobs_go_first_and_their_trouble_is_told() -> None:
    found, model, pages, _ = viewing(0.0)
    done: list[object] = []

    def failing(_: object) -> None:
        raise InputError("too large")

    found.ask(pages[0].viewer, done.append)
    found.ask(pages[0].viewer, failing)
    assert found.work() and found.work()
    assert done == [model]
    assert pages[0].told == ["too large"]
    assert pages[0].shown == []


def test_who_has_left_gets_nothing() -> None:
    found, _, pages, _ = viewing(0.0)
    found.leave(pages[0].viewer)
    assert not found.work()
    found.moved(pages[0].viewer, pose(1.0))
    found.looks(pages[0].viewer, Look("alpha"))
    assert not found.work()
    assert pages[0].shown == []


def test_without_a_model_nobody_is_served() -> None:
    found = Viewing(None)
    found.moved(found.join(FakePage()), pose())
    assert not found.work()


def test_a_training_gives_its_share_only() -> None:
    found, _, pages, clock = viewing(0.0)
    share = Share((0.2, 0.05))

    class Slow(FakeModel):
        def picture(self, camera: Any, look: Look, *, exact: bool) -> tuple[np.ndarray, str]:
            clock.now += 0.1
            return super().picture(camera, look, exact=exact)

    found.model = slow = Slow()
    # less by what a step of 0.01 s makes it late
    for moves, least, most in ((True, 0.17, 0.2), (False, 0.04, 0.051)):
        spent, start = 0.0, clock.now
        while clock.now < start + 100.0:
            before = clock.now
            if moves:
                found.moved(pages[0].viewer, pose(clock.now))
            if found.work(share):
                spent += clock.now - before
            clock.now += 0.01
            slow.version += 1
        assert least < spent / 100.0 < most


def test_waiting_ends_with_news(monkeypatch: pytest.MonkeyPatch) -> None:
    found = Viewing(FakeModel())
    viewer = found.join(FakePage())
    waits = threading.Event()

    def move() -> None:
        waits.wait()
        found.moved(viewer, pose())  # which needs the lock that waiting gives back

    noted(monkeypatch, found._news, "wait", lambda most: waits.set())
    mover = threading.Thread(target=move)
    mover.start()
    found.wait(threading.TIMEOUT_MAX)
    mover.join()
    assert found.work()
    found.wake()
    found.wait(threading.TIMEOUT_MAX)
