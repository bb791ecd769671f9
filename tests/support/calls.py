# SPDX-License-Identifier: Apache-2.0
"""Calling the command line in tests, and what it says."""

from __future__ import annotations

import os
import subprocess
import sys
import tracemalloc
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest

from clsplat.cli.main import main
from clsplat.config.training import TrainConfig
from clsplat.files.atomic import temporary_name

Capture = pytest.CaptureFixture[str]


def warnings_of(work: Callable[[], object]) -> list[str]:
    """The user's warnings of a piece of work, and NumPy's."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        work()
    return [str(warning.message) for warning in caught if warning.category in {UserWarning, RuntimeWarning}]


@contextmanager
def no_warnings() -> Iterator[None]:
    """Any warning is an error here."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def peak_of(work: Callable[[], object]) -> int:
    """Bytes that Python and NumPy have at most during a piece of work."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def flags(config: object, prefix: str = "--") -> list[str]:
    """Every setting as a user would give it."""
    words: list[str] = []
    for field in fields(config):  # type: ignore[arg-type]
        value, name = getattr(config, field.name), prefix + field.name.replace("_", "-")
        if is_dataclass(value):
            words += flags(value, f"{name}.")
        elif isinstance(value, tuple):
            words += [name, ",".join(map(str, value))]
        elif not isinstance(value, bool):
            words += [name, str(value)]
    return words


def train(scene: Path, run: Path, config: TrainConfig, *more: str) -> int:
    return main(["train", str(scene), "-o", str(run), *flags(config), *more])


def python(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """A Python process that is given these words, once it has ended; options: of subprocess.run."""
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    return python("-m", "clsplat", *arguments, timeout=120)


def error_line(capsys: Capture) -> str:
    """The one line on standard error, and nothing on standard output."""
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert captured.out == "", captured
    assert len(lines) == 1, captured
    assert lines[0].startswith("clsplat: error: ")
    return lines[0]


def one_error(capfd: Capture) -> str:
    """The last words: nothing on standard output, one line of error, no traceback, nothing from any library."""
    captured = capfd.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("clsplat: error: "), captured.err
    assert captured.err.count("\n") == 1, captured.err
    return captured.err


def left_behind(target: Path) -> str:
    """Write what one who was killed while writing this file leaves beside it; its name."""
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    name = temporary_name(target).name.replace(f"{os.getpid():08x}", f"{ended.pid:08x}")
    target.with_name(name).write_bytes(b"half")
    return name
