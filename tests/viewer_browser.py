# SPDX-License-Identifier: Apache-2.0
"""A headless Chromium for the tests of the viewer's page, and `clsplat view` to open in it."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
"""WebGL without a GPU, and without the namespaces that containers lack."""
NAMES = ("chromium", "chromium-browser", "google-chrome")
SLOW = 60_000
"""Milliseconds for what takes one second on a machine that has nothing else to do."""


def chromium_path() -> str:
    """Of the browser; skips the test where there is none."""
    path = os.environ.get("CLSPLAT_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.skip("no chromium on the path (Debian: apt install chromium; or CLSPLAT_CHROMIUM names one)")
    return path


@contextmanager
def chromium() -> Iterator[Any]:
    """The browser, as Playwright has it."""
    api = pytest.importorskip("playwright.sync_api", reason="the extra `test` brings playwright")
    path = chromium_path()
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        yield browser
        browser.close()


@contextmanager
def clsplat(*arguments: str) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """A command that serves a page, with --port 0: its address, and the process, which is ended as by Ctrl-C."""
    pytest.importorskip("viser", reason="the extra `view` brings it")
    command = [sys.executable, "-m", "clsplat", *arguments, "--port", "0"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stderr is not None
    try:
        lines = []
        for line in process.stderr:
            lines.append(line)
            if found := re.search(r"viewer at (http://\S+?);? ", line):
                yield found[1].rstrip(";"), process
                break
        else:
            pytest.fail("".join(lines))
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            process.communicate(timeout=60)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            pytest.fail(f"{arguments[0]} does not end")


def kept(folder: Path, name: str) -> Path:
    """Where a screenshot goes: the folder that CLSPLAT_SCREENSHOTS names, or the test's own."""
    chosen = os.environ.get("CLSPLAT_SCREENSHOTS")
    place = Path(chosen) if chosen else folder
    place.mkdir(parents=True, exist_ok=True)
    return place / name


def choose(page: Any, label: str, option: str) -> None:
    """Of one of the page's lists."""
    page.get_by_label(label, exact=True).locator("visible=true").first.click(timeout=SLOW)
    page.get_by_role("option", name=option, exact=True).click(timeout=SLOW)
