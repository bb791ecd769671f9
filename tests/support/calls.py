# SPDX-License-Identifier: Apache-2.0
"""Calls of the command line and of functions in tests, and checks of their output, warnings and errors."""

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
    """Texts of the warnings for users, and of NumPy's, while `work` runs."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        work()
    return [str(warning.message) for warning in caught if warning.category in {UserWarning, RuntimeWarning}]


def warned(match: str, call: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """The result of a call. Fails unless it gives exactly one warning, which matches."""
    with pytest.warns(UserWarning, match=match) as caught:
        found = call(*arguments, **options)
    told = [str(each.message) for each in caught if issubclass(each.category, UserWarning)]  # no collected resources
    assert len(told) == 1, told
    return found


@contextmanager
def no_warnings() -> Iterator[None]:
    """Make every warning inside the block an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def only(items: Iterable[Any]) -> Any:
    """The only item. Fails if there is none or more than one."""
    (item,) = items
    return item


def peak_of(work: Callable[[], object]) -> int:
    """Peak of the bytes that Python and NumPy allocate while `work` runs."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def flags(config: object, prefix: str = "--") -> list[str]:
    """Flags of the command line for all settings except booleans."""
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
    """Run a command, and return its ended process. options: arguments of subprocess.run."""
    return subprocess.run([*map(str, words)], capture_output=True, text=True, check=False, **options)


def python(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run Python with these arguments, and return the ended process. options: arguments of subprocess.run."""
    return ended(sys.executable, *words, **options)


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    return python("-m", "clsplat", *arguments, timeout=120)


def refuses(
    match: str, call: Callable[..., object], *arguments: Any, error: type[Exception] = InputError, **options: Any
) -> str:
    """The message of the error that a call raises. Fails unless it matches, and if an InputError has several lines."""
    with pytest.raises(error, match=match) as caught:
        call(*arguments, **options)
    message = str(caught.value)
    del caught  # otherwise the call's frames and their open files live until a garbage collection
    assert error is not InputError or "\n" not in message
    return message


def refusal(read: Callable[[], object]) -> str:
    """The message of the InputError, which is one printable line."""
    said = refuses(".", read)
    assert said.isprintable()
    return said


def complaint(path: object, call: Callable[..., object], *arguments: Any, **options: Any) -> str:
    """The message of the InputError that a call raises, without the path at its beginning."""
    start = f"{path}: "
    return refuses(f"^{re.escape(start)}", call, *arguments, **options).removeprefix(start)


def ran(capsys: Capture, call: Callable[..., int], *arguments: Any, status: int = 0, **options: Any) -> Any:
    """Output and errors of a call. Fails unless it returns `status`."""
    assert call(*arguments, **options) == status, arguments
    return capsys.readouterr()


def fails(capsys: Capture, call: Callable[..., int], *arguments: Any, status: int = 2, **options: Any) -> str:
    """The line of error of a call. Fails unless it returns `status`, and prints only that line."""
    assert call(*arguments, **options) == status, arguments
    return error_line(capsys)


def printed(capsys: Capture, words: Iterable[object], *, call: Callable[[list[str]], int] = main, **how: Any) -> Any:
    """Output and errors of a call of the command line. how: its expected status, if not 0."""
    return ran(capsys, call, [*map(str, words)], **how)


def rejected(capsys: Capture, words: Iterable[object], *, call: Callable[[list[str]], int] = main, **how: Any) -> str:
    """The line of error of a call of the command line. how: its expected status, if not 2."""
    return fails(capsys, call, [*map(str, words)], **how)


def raising(error: BaseException) -> Callable[..., Any]:
    """A function that raises this error for any arguments."""

    def call(*_: object, **__: object) -> NoReturn:
        raise error

    return call


def noted(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, note: Callable[..., object]) -> None:
    """Let each call of a function or method call `note` first, with the same arguments. Errors of `note` propagate."""
    real = getattr(owner, name)

    def call(*arguments: Any, **options: Any) -> Any:
        note(*arguments, **options)
        return real(*arguments, **options)

    monkeypatch.setattr(owner, name, call)


def error_line(capsys: Capture) -> str:
    """The line on standard error. Fails if there is another one, or any standard output."""
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert captured.out == "", captured
    assert len(lines) == 1, captured
    assert lines[0].startswith("clsplat: error: ")
    return lines[0]


def one_error(capfd: Capture) -> str:
    """The line of error. Fails if there is anything else in the output, such as a traceback or a library's message."""
    captured = capfd.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("clsplat: error: "), captured.err
    assert captured.err.count("\n") == 1, captured.err
    return captured.err


def left_behind(target: Path) -> str:
    """Write the temporary file of a process that was killed while it wrote `target`. Returns the file's name."""
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    name = temporary_name(target).name.replace(f"{os.getpid():08x}", f"{child.pid:08x}")
    target.with_name(name).write_bytes(b"half")
    return name
