# SPDX-License-Identifier: Apache-2.0
"""Calling the command line in tests, and what it says."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tracemalloc
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, NoReturn

import pytest

from clsplat.cli.main import main
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError
from clsplat.files.atomic import temporary_name

Capture = pytest.CaptureFixture[str]


def warnings_of(work: Callable[[], object]) -> list[str]:
    """The user's warnings of a piece of work, and NumPy's."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        work()
    return [str(warning.message) for warning in caught if warning.category in {UserWarning, RuntimeWarning}]


def warned(match: str, call: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """The result of a call that gives one warning; fails unless the warning matches."""
    with pytest.warns(UserWarning, match=match) as caught:
        found = call(*arguments, **options)
    assert len(caught) == 1, [str(each.message) for each in caught]
    return found


@contextmanager
def no_warnings() -> Iterator[None]:
    """Any warning is an error here."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def only(items: Iterable[Any]) -> Any:
    """The one item that there is."""
    (item,) = items
    return item


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


def ended(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """The process of this command, once it has ended; options: of subprocess.run."""
    return subprocess.run([*map(str, words)], capture_output=True, text=True, check=False, **options)


def python(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """A Python process that is given these words, once it has ended; options: of subprocess.run."""
    return ended(sys.executable, *words, **options)


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    return python("-m", "clsplat", *arguments, timeout=120)


def refuses(
    match: str, call: Callable[..., object], *arguments: Any, error: type[Exception] = InputError, **options: Any
) -> str:
    """The message of the error that the call raises, of an InputError one line; fails unless it matches."""
    with pytest.raises(error, match=match) as caught:
        call(*arguments, **options)
    message = str(caught.value)
    del caught  # else the frames of the call, and the files that they have open, live until garbage is collected
    assert error is not InputError or "\n" not in message
    return message


def complaint(path: object, call: Callable[..., object], *arguments: Any, **options: Any) -> str:
    """The words behind the file's name in the InputError that the call raises."""
    start = f"{path}: "
    return refuses(f"^{re.escape(start)}", call, *arguments, **options).removeprefix(start)


def ran(capsys: Capture, call: Callable[..., int], *arguments: Any, status: int = 0, **options: Any) -> Any:
    """Output and errors of a call, which ends with this status."""
    assert call(*arguments, **options) == status, arguments
    return capsys.readouterr()


def fails(capsys: Capture, call: Callable[..., int], *arguments: Any, status: int = 2, **options: Any) -> str:
    """The one line of error of a call, which ends with this status."""
    assert call(*arguments, **options) == status, arguments
    return error_line(capsys)


def printed(capsys: Capture, words: Iterable[object], *, call: Callable[[list[str]], int] = main, **how: Any) -> Any:
    """Output and errors of a call of the command line; how: its status."""
    return ran(capsys, call, [*map(str, words)], **how)


def rejected(capsys: Capture, words: Iterable[object], *, call: Callable[[list[str]], int] = main, **how: Any) -> str:
    """The one line of error of a call of the command line; how: its status."""
    return fails(capsys, call, [*map(str, words)], **how)


def raising(error: BaseException) -> Callable[..., Any]:
    """A function that raises this error, whatever it is called with."""

    def call(*_: object, **__: object) -> NoReturn:
        raise error

    return call


def noted(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, note: Callable[..., object]) -> None:
    """Let each call of a function or method go to `note` first, with the same arguments; what `note` raises ends it."""
    real = getattr(owner, name)

    def call(*arguments: Any, **options: Any) -> Any:
        note(*arguments, **options)
        return real(*arguments, **options)

    monkeypatch.setattr(owner, name, call)


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
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    name = temporary_name(target).name.replace(f"{os.getpid():08x}", f"{child.pid:08x}")
    target.with_name(name).write_bytes(b"half")
    return name
