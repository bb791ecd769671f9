# SPDX-License-Identifier: Apache-2.0
"""The command line's verbs, and the parsing of their arguments by tyro."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import make_dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_origin

import tyro
from tyro.conf import subcommand

from clsplat.cli.flags import grouped_help, near, unknown_flags
from clsplat.cli.options import Verb

DESCRIPTION = "3D Gaussian Splatting on any OpenCL device: photos in, scene out."
VERBS = {
    "devices": "List the OpenCL devices.",
    "doctor": "Say what is installed and what is missing: packages, OpenCL drivers, devices, GPUs without a "
    "driver; and what to install for them on this system.",
    "demo": "Make photographs of a small scene, recover their cameras, train, evaluate and render a turntable.",
    "sfm": "Turn a folder of photos into a scene: COLMAP's cameras and points, and the undistorted images.",
    "train": "Train a scene.",
    "eval": "Measure a model on a scene's held-out views: PSNR, SSIM, and LPIPS where the extra is installed.",
    "render": "Render a model from the cameras of a file or along a path made from them, an image for each frame.",
    "stmaps": "Write the lenses of a scene's photographs as STMaps, to distort a render and to undistort a photograph.",
    "thumbnail": "Draw one picture of a model: of a run from among its photographs, of a file of all of it, or of "
    "what a scene has most detail of.",
    "view": "Look at a model in the browser: the device renders, the page shows it.",
    "report": "Write a run's report: one HTML file with curves, pictures, figures and settings, that "
    "loads nothing else.",
    "compare": "Print runs side by side: scores, Gaussians, times, and the settings that differ.",
    "convert": "Write a model in another format, by the files' endings, and say what was lost; or edit it on the way.",
    "info": "Say what a model file holds: format, count, SH, bounds, scales, opacities, colour space, "
    "what is not finite.",
    "bench": "Measure each stage of a frame and of a training step, and the device's own limits in the same run.",
    "tune": "Find the quickest shape of the kernels for a device by a short trial, and keep it for later runs.",
    "selftest": "Test every device: build the kernels, run each stage on frozen scenes, compare with "
    "float64 and stored digests.",
}
"""The verbs in the order of --help, with the first sentence of each one's help. Each is a module of `clsplat.cli`, with
a class of its name and a function `run`. A module is imported when its verb is called."""


def verb_module(name: str) -> Any:
    """The module of a verb: its arguments and its function."""
    return import_module(f"clsplat.cli.{name}")


def verb_class(name: str) -> type[Verb]:
    """The arguments of a verb."""
    kind: type[Verb] = getattr(verb_module(name), name.capitalize())
    return kind


def _listed(name: str) -> type:
    """A verb that is not called: its line in the list of verbs, without arguments."""
    return make_dataclass(name.capitalize(), (), namespace={"__doc__": VERBS[name]})


def parse(arguments: Sequence[str]) -> Verb:
    """The verb that the command line asks for. Raises InputError, and SystemExit with the trouble reported in one line,
    or after the help has been printed."""
    kinds = {name: verb_class(name) if name in arguments else _listed(name) for name in VERBS}
    commands: Any = Union[tuple(Annotated[kind, subcommand(name)] for name, kind in kinds.items())]  # noqa: UP007
    boxes = io.StringIO()
    helping = not {"-h", "--help"}.isdisjoint(arguments)
    called = verb_class(arguments[0]) if arguments and arguments[0] in VERBS else None
    if helping and called is not None and called.groups:
        print(grouped_help(called, f"clsplat {arguments[0]}", called.groups))
        raise SystemExit(0)
    try:
        with _text_rules(), contextlib.redirect_stderr(boxes), contextlib.nullcontext() if helping else _wide():
            verb: Verb = tyro.cli(commands, args=list(arguments), prog="clsplat", description=DESCRIPTION)
    except SystemExit as error:
        if error.code == 2:
            report(_trouble(arguments, called, _unboxed(boxes.getvalue())), 2, arguments)
        else:
            sys.stderr.write(boxes.getvalue())
        raise
    flags = [word.partition("=")[0][2:].replace("-", "_") for word in arguments if word.startswith("--")]
    return verb.completed({*flags, *(re.sub(r"(^|\.)no_", r"\1", flag) for flag in flags)})


_UNION = re.compile(r"no type matching \{None\}\|.* could be instantiated from .*\. Got errors: .*- <class '\w+'>: ")
"""Begins what tyro says of a number that may be left out, before what is wrong with it."""


def _trouble(arguments: Sequence[str], called: type[Verb] | None, said: str) -> str:
    """The trouble with a call: flags and verbs that are not there, with near names, else what tyro has `said`."""
    said = _UNION.sub("", said)
    if called is not None:
        return unknown_flags(arguments[1:], called, f"clsplat {arguments[0]}") or said
    word = next((word for word in arguments if not word.startswith("-")), "")
    if not word or word in VERBS:
        return said
    found = near(word, list(VERBS))
    return f"{word} is no verb, did you mean {found}?" if found else said


def _text_rules() -> tyro.constructors.ConstructorRegistry:
    """Rules for flags of one word: lists of steps are written 500,1000,2000, where tyro expects spaces. An empty path,
    as a shell makes it of a variable that is not set, is refused: it is not the working directory."""
    registry = tyro.constructors.ConstructorRegistry()

    @registry.primitive_rule
    def rule(info: tyro.constructors.PrimitiveTypeInfo) -> tyro.constructors.PrimitiveConstructorSpec[Any] | None:
        kind: Any
        value_of: Any
        text_of: Any
        if info.type is Path:
            kind, metavar, value_of, text_of = Path, "PATH", _path, str
        elif get_origin(info.type) is tuple and set(get_args(info.type)) <= {int, Ellipsis}:
            kind, metavar, value_of, text_of = tuple, "STEP,STEP,...", _steps, lambda steps: ",".join(map(str, steps))
        else:
            return None
        return tyro.constructors.PrimitiveConstructorSpec(
            nargs=1,
            metavar=metavar,
            instance_from_str=lambda words: value_of(words[0]),
            is_instance=lambda value: isinstance(value, kind),
            str_from_instance=lambda value: [text_of(value)],
        )

    return registry


def _path(text: str) -> Path:
    if not text:
        raise ValueError("the path is empty, expected a name")
    return Path(text)


def _steps(text: str) -> tuple[int, ...]:
    try:
        steps = tuple(int(word) for word in text.split(",") if word.strip())
    except ValueError:
        raise ValueError(f"{text!r} is not a list of steps, expected such as 500,1000,2000") from None
    return steps


@contextlib.contextmanager
def _wide() -> Iterator[None]:
    """Make the terminal look wide: a report that becomes one line must not be wrapped first."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "10000"
    try:
        yield
    finally:
        del os.environ["COLUMNS"]
        if before is not None:
            os.environ["COLUMNS"] = before


def _unboxed(report: str) -> str:
    """The message of one of tyro's boxes as one line, without the frame and the advice below."""
    words: list[str] = []
    titled = "╭" in report  # else, where standard output is not UTF-8, the first rule is below the title
    for line in report.splitlines():
        text = line.strip("│ ").strip()
        if text.startswith("╭") or not text:
            continue
        if text.startswith(("─", "╰")) or not text.strip("-"):
            if titled:
                break
            titled = True
            words.clear()
        else:
            words.append(text)
    return " ".join(" ".join(words).split()) or "the call is wrong, see clsplat --help"


def report(message: str, status: int, arguments: Sequence[str]) -> None:
    """Tell of an error; where the command line asks for JSON, as an object on standard output too."""
    tell(f"clsplat: error: {message}")
    if "--json" in arguments:
        print(as_json(message, status), flush=True)


def as_json(message: str, status: int) -> str:
    """An error, for a program that asked for JSON."""
    return json.dumps({"error": message, "status": status})


def tell(line: str) -> None:
    """Print on standard error if that is possible; the exit status says the same."""
    try:
        print(line, file=sys.stderr, flush=True)
    except OSError:  # text left in the stream would make the interpreter end with a status of its own
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())
