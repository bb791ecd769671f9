# SPDX-License-Identifier: Apache-2.0
"""A headless Chromium for tests of pages: the system's own, driven by Playwright. Skips with the reason without one.

`browser` is a fixture (conftest.py). Screenshots go to the folder that CLSPLAT_ARTEFACTS names, or the test's own.
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
"""Of root in a container, with little shared memory; WebGL without a GPU."""


@pytest.fixture(scope="module")  # while it is open there is an event loop in this thread, which other tests may mind
def browser() -> Iterator[Any]:
    """A Playwright browser. Make a page of it with `browser.new_page()`, and close that."""
    for name in ("playwright", "chromium"):
        require(name)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=chromium_path(), args=list(ARGUMENTS))
        yield opened
        opened.close()


def watched_page(browser: Any, **options: Any) -> tuple[Any, list[str]]:
    """A page, and what it said on its console or could not load, of errors alone; options as of `new_page`."""
    page, trouble = browser.new_page(**options), []
    page.on("console", lambda message: trouble.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: trouble.append(str(error)))
    page.on("requestfailed", lambda request: trouble.append(f"{request.url[:100]}: {request.failure}"))
    return page, trouble


def kept(folder: Path, name: str) -> Path:
    """Where a screenshot goes; `folder` is the test's own."""
    place = Path(os.environ.get("CLSPLAT_ARTEFACTS") or folder)
    place.mkdir(parents=True, exist_ok=True)
    return place / name
