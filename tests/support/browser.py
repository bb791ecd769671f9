# SPDX-License-Identifier: Apache-2.0
"""The system's Chromium, headless and driven by Playwright, for tests of pages. Without it such a test is skipped.

`browser` is a fixture (conftest.py). Screenshots go to the folder that CLSPLAT_ARTEFACTS names, or to the test's own.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from needs import chromium_path, require

ARGUMENTS = (
    *("--no-sandbox", "--disable-dev-shm-usage"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
)
"""Chromium's arguments for root in a container with little shared memory, and for WebGL without a GPU."""


@pytest.fixture(scope="module")  # an open browser has an event loop in this thread, which may disturb other tests
def browser() -> Iterator[Any]:
    """A Playwright browser. A test opens a page with `browser.new_page()`, and closes it."""
    for name in ("playwright", "chromium"):
        require(name)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=chromium_path(), args=list(ARGUMENTS))
        yield opened
        opened.close()


def watched_page(browser: Any, **options: Any) -> tuple[Any, list[str]]:
    """A new page, and a list of its errors: on its console, in its scripts, and of failed requests.

    options: arguments of `browser.new_page`.
    """
    page, trouble = browser.new_page(**options), []
    page.on("console", lambda message: trouble.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: trouble.append(str(error)))
    page.on("requestfailed", lambda request: trouble.append(f"{request.url[:100]}: {request.failure}"))
    return page, trouble


def kept(folder: Path, name: str) -> Path:
    """Path of a screenshot. folder: the test's own, used without CLSPLAT_ARTEFACTS."""
    place = Path(os.environ.get("CLSPLAT_ARTEFACTS") or folder)
    place.mkdir(parents=True, exist_ok=True)
    return place / name
