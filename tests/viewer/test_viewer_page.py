# SPDX-License-Identifier: Apache-2.0
"""The viewer in a real browser: what a user does there, from opening the page to rendering a recorded path."""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import kept
from needs import require
from systems import posix
from tiny import CONFIG, cameras
from viewer_browser import SLOW, choose, clsplat

from clsplat.cli.main import main
from clsplat.config.orientation import parse_scale
from clsplat.device.selection import open_device
from clsplat.gaussians import Gaussians
from clsplat.images.reading import read_image
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.orientation.known_length import metres_per_unit
from clsplat.shots import choose_shot
from clsplat.viewer.pose import start_of

require("viser")
PAGE = {"width": 900, "height": 600}
EXACT = re.compile(r"^\d+ x \d+, exact$")
"""The remark on an exact picture, which has fewer pixels than the page where the browser is slow."""
CLEAR = (slice(250, 580), slice(20, 560))
"""Rows and columns of the page where no panel is, nor the frame of a key that was recorded here."""


@pytest.fixture(scope="module")
def served(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path]]:
    """The address of the trained model's viewer, and the folder where it saves paths."""
    paths = tmp_path_factory.mktemp("paths")
    with clsplat("view", str(trained), "--paths", str(paths)) as (url, _):
        yield url, paths


def opened(browser: Any, url: str) -> Any:
    """A page with its exact picture."""
    page = browser.new_page(viewport=PAGE)
    page.set_default_timeout(SLOW)
    page.goto(url)
    page.get_by_text("exact").wait_for()
    return page


def picture(page: Any, path: Path) -> np.ndarray:
    """(H, W, 3) of the part of the page that has no panels, when it has come to rest."""
    before, after = None, page.screenshot()
    for _ in range(100):
        if before == after:
            break
        page.wait_for_timeout(400)
        before, after = after, page.screenshot()
    path.write_bytes(after)
    return read_image(path)[CLEAR]


def shot(page: Any, folder: Path, size: tuple[int, int]) -> np.ndarray:
    """A screenshot as the page offers it for download."""
    page.get_by_role("tab", name="Screenshot").click()
    for name, side in zip(("Width", "Height"), size, strict=True):
        field = page.get_by_label(name, exact=True).locator("visible=true").first
        field.fill(str(side))
        field.press("Enter")
    page.wait_for_timeout(500)
    with page.expect_download() as download:
        page.get_by_role("button", name="Take screenshot").click()
    path = folder / "shot.png"
    download.value.save_as(path)
    assert download.value.suggested_filename == "screenshot.png"
    return read_image(path)


def record(page: Any, folder: Path) -> Path:
    """The one key that is here, as a file of cameras."""
    page.get_by_role("tab", name="Path").click()
    page.get_by_role("button", name="Clear keys").click()
    page.get_by_role("button", name="Add key").click()
    page.get_by_text(re.compile("^1 key$")).wait_for()
    with page.expect_download() as download:
        page.get_by_role("button", name="Download path").click()
    path = folder / "one.json"
    download.value.save_as(path)
    page.get_by_role("button", name="Clear keys").click()
    return path


def test_the_page_shows_what_render_does(browser: Any, served: tuple[str, Path], trained: Path, tmp_path: Path) -> None:
    page = opened(browser, served[0])
    try:
        image = picture(page, kept(tmp_path, "colour.png"))
        camera = choose_shot(record(page, tmp_path), path=None, count=None).frames[0].camera
        gaussians = Gaussians.load(trained / "model.ply")
        # the path's picture is of another shape: the same vertical angle on the page's
        focal = camera.fy * PAGE["height"] / camera.height
        own = type(camera)(
            PAGE["width"], PAGE["height"], focal, focal, PAGE["width"] / 2, PAGE["height"] / 2, camera.rotation,
            camera.translation,
        )  # fmt: skip
        renderer = Renderer(open_device())
        wanted = renderer.render(gaussians, own).image[CLEAR]
        assert wanted.std() > 0.05, "something is seen there"
        # JPEG, and a page of fewer pixels where the browser is slow; 0.2 and more where it is mirrored or shifted
        assert np.abs(image - np.clip(wanted, 0, 1)).mean() < 0.02
        exact = shot(page, tmp_path, (320, 180))
        main(["render", str(trained), "--cameras", str(tmp_path / "one.json"), "--width", "320", "--height", "180",
              "-o", str(tmp_path / "render.png")])  # fmt: skip
        np.testing.assert_array_equal(exact, read_image(tmp_path / "render.png"))
    finally:
        page.close()


def test_a_phone_held_upright_shows_the_first_photograph_from_side_to_side(
    browser: Any, served: tuple[str, Path], tmp_path: Path
) -> None:
    """And turned, what a wide page shows. In motion nothing says exact."""
    page = browser.new_page(viewport={"width": 390, "height": 844})
    page.set_default_timeout(SLOW)
    try:
        page.goto(served[0])
        page.get_by_text(EXACT).wait_for()
        page.screenshot(path=kept(tmp_path, "upright.png"))
        start = start_of(cameras(), np.zeros((0, 3)))
        found = choose_shot(record(page, tmp_path), path=None, count=None).frames[0].camera
        across = math.tan(start.fov / 2) * start.aspect  # that of the page, which a wide picture has down
        assert 0.5 * found.height / found.fy == pytest.approx(across, rel=1e-4)  # the browser's degrees
        page.set_viewport_size(PAGE)
        page.wait_for_timeout(2000)
        page.get_by_text(EXACT).wait_for()
        found = choose_shot(record(page, tmp_path), path=None, count=None).frames[0].camera
        assert 0.5 * found.height / found.fy == pytest.approx(math.tan(start.fov / 2), rel=1e-4)
        page.mouse.move(200, 400)
        page.mouse.down()
        for step in range(10):
            page.mouse.move(200 + 8 * step, 400)
            page.wait_for_timeout(30)
        page.wait_for_function(  # both at one moment: on a busy machine "coarse" soon becomes "exact" again
            "() => document.body.innerText.includes('coarse') && !/exact/i.test(document.body.innerText)"
        )
        page.mouse.up()
        page.get_by_text(EXACT).wait_for()
    finally:
        page.close()


@pytest.mark.slow
def test_orbit_depth_and_a_path_that_is_rendered(
    browser: Any, served: tuple[str, Path], trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    url, paths = served
    page = opened(browser, url)
    try:
        first = picture(page, kept(tmp_path, "before.png"))
        page.get_by_role("tab", name="Path").click()
        page.get_by_role("button", name="Add key").click()
        page.mouse.move(200, 400)
        page.mouse.down()
        for step in range(20):
            page.mouse.move(200 + 8 * step, 400 + 3 * step)
            page.wait_for_timeout(20)
        page.mouse.up()
        second = picture(page, kept(tmp_path, "orbited.png"))
        assert np.abs(first - second).mean() > 0.02
        page.get_by_role("button", name="Add key").click()
        page.get_by_text("2 keys").wait_for()

        page.get_by_role("tab", name="View").click()
        choose(page, "Show", "depth")
        page.get_by_text("(bright) to").wait_for()
        depth = picture(page, kept(tmp_path, "depth.png"))
        assert np.abs(depth - second).mean() > 0.02
        choose(page, "Show", "count")
        page.get_by_text("Gaussians per pixel").wait_for()
        choose(page, "Show", "alpha")
        page.get_by_text("Gaussians per pixel").wait_for(state="detached")
        alpha = picture(page, kept(tmp_path, "alpha.png"))
        np.testing.assert_allclose(alpha[:, :, 0], alpha[:, :, 2], atol=2 / 255)  # grey
        choose(page, "Show", "colour")
        choose(page, "Cameras", "photos")
        page.wait_for_timeout(1500)
        picture(page, kept(tmp_path, "cameras.png"))

        page.get_by_role("tab", name="Path").click()
        field = page.get_by_label("Seconds between keys", exact=True)
        field.fill("0.25")
        field.press("Enter")
        page.wait_for_timeout(500)
        page.get_by_role("button", name="Save path").click()
        page.get_by_text("saved as path-001.json").first.wait_for()
        page.screenshot(path=kept(tmp_path, "path.png"))
    finally:
        page.close()
    (saved,) = paths.iterdir()
    document = json.loads(saved.read_text())
    assert len(document["keys"]) == 2
    assert document["keys"][0]["position"] != document["keys"][1]["position"]
    frames = tmp_path / "frames"
    capsys.readouterr()
    assert main(["render", str(trained), "--cameras", str(saved), "--width", "64", "-o", f"{frames}/####.png"]) == 0
    assert len(list(frames.iterdir())) == 7
    assert read_image(frames / "0001.png").max() > 0.2


def roll_of(page: Any, folder: Path) -> np.ndarray:
    """The camera's right and down in the world, (2, 3), of a key that is added here."""
    camera = choose_shot(record(page, folder), path=None, count=None).frames[0].camera
    page.get_by_role("tab", name="View").click()
    return camera.rotation[:2]


@pytest.mark.slow
def test_up_and_roll(browser: Any, served: tuple[str, Path], tmp_path: Path) -> None:
    """A roll of 90 degrees has to the right what was down; what is up is level with the camera."""
    page = opened(browser, served[0])
    try:
        before = picture(page, kept(tmp_path, "level.png"))
        right, down = roll_of(page, tmp_path)
        row = page.locator("div.mantine-Flex-root", has=page.get_by_text("Roll", exact=True))
        field = row.locator("input[inputmode=decimal]").last
        field.fill("90")
        field.press("Enter")
        page.wait_for_timeout(500)
        assert np.abs(picture(page, kept(tmp_path, "rolled.png")) - before).mean() > 0.02
        np.testing.assert_allclose(roll_of(page, tmp_path), [down, -right], atol=1e-3)  # the browser's float32
        field.fill("0")
        field.press("Enter")
        for name, axis in (("z", (0, 0, 1)), ("-x", (-1, 0, 0))):
            choose(page, "Up", name)
            page.wait_for_timeout(500)
            across, below = roll_of(page, tmp_path)
            assert abs(across @ axis) < 1e-3
            assert below @ axis < 0
    finally:
        page.close()


@pytest.mark.slow
def test_two_clicks_and_a_length_give_a_flag(browser: Any, served: tuple[str, Path], tmp_path: Path) -> None:
    page = opened(browser, served[0])
    try:
        picture(page, kept(tmp_path, "start.png"))
        page.get_by_role("tab", name="Measure").click()
        page.get_by_role("button", name="Pick two points").click()
        page.get_by_text("Click on a point.").wait_for()
        page.mouse.click(PAGE["width"] / 2 - 60, PAGE["height"] / 2)
        page.get_by_text("Click on a second point.").wait_for()
        page.mouse.click(PAGE["width"] / 2 + 40, PAGE["height"] / 2 + 30)
        page.get_by_text("Enter its length in metres").wait_for()
        field = page.get_by_label("Length in metres", exact=True)
        field.fill("1.25")
        field.press("Enter")
        page.get_by_text(re.compile(r"--scale=.*=1\.25")).wait_for()
        page.screenshot(path=kept(tmp_path, "measured.png"))
        text = page.inner_text("body")
        distance = float(re.findall(r"Distance: (\S+) world units", text)[0])
        rule = parse_scale(re.findall(r"--scale=(\S+)", text)[0])
        assert rule is not None
        assert 1.25 / metres_per_unit(rule, {}) == pytest.approx(distance, rel=1e-4)
        assert 0.1 < distance < 4  # the model is a ball of radius 1
        page.mouse.click(PAGE["width"] / 2, PAGE["height"] / 2)  # the third click picks nothing
        page.wait_for_timeout(1000)
        assert f"Distance: {distance:.6g} world" in page.inner_text("body")
    finally:
        page.close()


@pytest.mark.slow
def test_two_pages_have_their_own_cameras(browser: Any, served: tuple[str, Path], tmp_path: Path) -> None:
    one, other = opened(browser, served[0]), opened(browser, served[0])
    try:
        before = picture(one, tmp_path / "one.png")
        np.testing.assert_allclose(picture(other, tmp_path / "other.png"), before, atol=0.05)
        other.bring_to_front()
        other.mouse.move(200, 400)
        other.mouse.wheel(0, 800)
        choose(other, "Show", "alpha")
        other.wait_for_timeout(1000)
        moved = picture(other, tmp_path / "moved.png")
        one.bring_to_front()
        np.testing.assert_allclose(picture(one, tmp_path / "still.png"), before, atol=0.05)
        assert np.abs(moved - before).mean() > 0.02
    finally:
        one.close()
        other.close()


@pytest.mark.slow
@posix
def test_a_training_is_watched_and_paused(browser: Any, scene: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    arguments = ("train", str(scene), "-o", str(run), "--iterations", "1000000", "--view", "--checkpoint-every", "0")
    with clsplat(*arguments, "--sh-degree", str(CONFIG.sh_degree)) as (url, process):
        page = opened(browser, url)

        def step() -> int:
            found = re.search(r"step ([\d,]+) of", page.inner_text("body"))
            return int(found[1].replace(",", "")) if found else -1

        def later(than: int) -> int:
            for _ in range(200):
                if step() > than:
                    return step()
                page.wait_for_timeout(200)
            return pytest.fail(f"no step after {than}")

        later(later(0))
        page.get_by_role("button", name="Pause").click()
        page.get_by_text("paused: step").wait_for()
        held = step()
        page.mouse.move(200, 400)
        page.mouse.wheel(0, 400)
        picture(page, kept(tmp_path, "paused.png"))
        assert step() == held, "a paused training makes no steps, while its page moves"
        page.get_by_role("button", name="Resume").click()
        later(held)
        page.get_by_role("button", name="Pause").click()
        page.get_by_text("paused: step").wait_for()
        process.send_signal(2)  # Ctrl-C ends a training that is paused
        start = time.monotonic()
        assert process.wait(60) == 130
        assert time.monotonic() - start < 30
        page.close()
    assert list((run / "checkpoints").iterdir())
