# SPDX-License-Identifier: Apache-2.0
"""`clsplat view` for tests with a browser (browser.py), and actions on its page."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from clsplat.errors import ClsplatError

SLOW = 60_000
"""Time limit in milliseconds of an action that takes one second on an idle machine."""


@contextmanager
def clsplat(*arguments: str) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """Run a command that serves a page, with --port 0. Yields the page's address and the process.

    After the block, the process is ended like by Ctrl-C.
    """
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
            raise ClsplatError(f"clsplat {arguments[0]} has ended: {' '.join(lines)}")
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            process.communicate(timeout=60)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            raise ClsplatError(f"clsplat {arguments[0]} does not end") from None


def choose(page: Any, label: str, option: str) -> None:
    """Choose an option of the list with this label on the page."""
    page.get_by_label(label, exact=True).locator("visible=true").first.click(timeout=SLOW)
    page.get_by_role("option", name=option, exact=True).click(timeout=SLOW)
