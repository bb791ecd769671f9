# SPDX-License-Identifier: Apache-2.0
"""Verbs of the command line, and parsing of their arguments by tyro."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import make_dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Union, get_args, get_origin

import tyro
from tyro.conf import HelptextFromCommentsOff, subcommand

from clsplat.cli.flags import grouped_help, near, unknown_flags
from clsplat.cli.options import Verb
from clsplat.progress import aligned

if TYPE_CHECKING:
    from clsplat.cli.session import Services

PROGRAM_DESCRIPTION = "3D Gaussian Splatting on any OpenCL device: photos in, scene out."
VERBS = {
    "devices": "List the OpenCL devices.",
    "doctor": "List installed and missing packages, OpenCL drivers, devices and GPUs without a driver, with "
    "installation advice for this system.",
    "demo": "Make photographs of a small scene, recover their cameras, train, evaluate and render a turntable.",
    "capture": "Turn photos or videos into a trained model, with its report, thumbnail and turntable.",
    "sfm": "Turn photos and videos into a scene: COLMAP's cameras and points, and the undistorted images.",
    "train": "Train a scene.",
    "blocks plan": "Divide a large scene into blocks, which can be trained on many machines.",
    "blocks train": "Train one block of a plan, as a run in CITY/blocks.",
    "blocks merge": "Merge the models of all blocks into CITY/merged.ply.",
    "blocks finish": "Train the merged model on all photographs, evaluate it, and write the report.",
    "eval": "Measure a model on a scene's held-out views: PSNR, SSIM, and LPIPS if the extra is installed.",
    "render": "Render a model from the cameras of a file or along a path made from them, an image for each frame.",
    "stmaps": "Write the lenses of a scene's photographs as STMaps, to distort a render and to undistort a photograph.",
    "thumbnail": "Draw one picture of a model, for lists and galleries.",
    "view": "Look at a model in the browser: the device renders, the page shows it.",
    "report": "Write a run's report: one self-contained HTML file with curves, pictures, figures and settings.",
    "compare": "Compare runs in a table: scores, Gaussians, times, and the settings that differ.",
    "convert": "Convert a model to the format of the output file's ending, with optional edits, and report rounding "
    "errors.",
    "info": "Describe a model file: format, count, SH, bounds, scales, opacities, colour space, place on the earth "
    "and values that are not finite.",
    "bench": "Measure each stage of a frame and of a training step, and the limits of the device in the same run.",
    "tune": "Find a device's quickest kernel shape by a short trial, and save it for later runs.",
    "selftest": "Test every device: build the kernels, compare each stage with its float64 "
    "reference and with stored digests.",
}
"""Verbs in the order of --help, with the first sentence of each one's help. A verb may have two words.

Each verb is a module of `clsplat.cli`, with a class NAMEVerb and a function `run`. A module is imported only when its
verb is called.
"""
_VERB_MODULES = {
    "render": "render.verb",
    **{f"blocks {name}": f"blocks.{name}" for name in ("plan", "train", "merge", "finish")},
}
"""Module, relative to `clsplat.cli`, of each verb that has a folder of its own."""


def verb_module(name: str) -> Any:
    """Import the module of a verb, which has the verb's dataclass of arguments and its function `run`."""
    return import_module(f"clsplat.cli.{_VERB_MODULES.get(name, name)}")


def verb_class(name: str) -> type[Verb]:
    """Import the dataclass of a verb's arguments, such as `TrainVerb` for "train", BlocksPlanVerb for "blocks plan"."""
    kind: type[Verb] = getattr(verb_module(name), f"{_class_name(name)}Verb")
    return kind


def run_function(verb: Verb) -> Callable[[Verb, Services], int]:
    """Return the function `run` of a verb's module."""
    name = next(name for name in VERBS if f"{_class_name(name)}Verb" == type(verb).__name__)
    function: Callable[[Verb, Services], int] = verb_module(name).run
    return function


def _class_name(name: str) -> str:
    return "".join(word.capitalize() for word in name.split())


def _listed(name: str) -> type:
    """Placeholder class without arguments, for a verb that `clsplat --help` only lists."""
    return make_dataclass(_class_name(name), (), namespace={"__doc__": VERBS[name]})


def _joined(arguments: Sequence[str]) -> list[str]:
    """Join the first two words to the name of a verb of two words. Without such a verb, the words stay apart."""
    name = " ".join(arguments[:2])
    return [name, *arguments[2:]] if name in VERBS and " " in name else list(arguments)


def _family(arguments: Sequence[str]) -> list[str]:
    """Return the verbs of two words that begin with the first word of a command line."""
    return [name for name in VERBS if arguments and name.startswith(f"{arguments[0]} ")]


def parse(arguments: Sequence[str]) -> Verb:
    """Parse a command line. Returns the verb with its arguments.

    Raises InputError. Raises SystemExit after reporting an error in one line, or after printing the help.
    """
    arguments = _joined(arguments)
    family = _family(arguments)  # such as the verbs that `clsplat blocks --help` lists
    if family and set(arguments[1:]) <= {"-h", "--help"}:
        if arguments[1:]:
            print("\n".join(aligned([(f"clsplat {name}", VERBS[name]) for name in family], left=(0, 1))))
            raise SystemExit(0)
        report(f"{arguments[0]} is not complete, expected one of {', '.join(family)}", 2, arguments)
        raise SystemExit(2)
    boxes = io.StringIO()
    helping = not {"-h", "--help"}.isdisjoint(arguments)
    called = verb_class(arguments[0]) if arguments and arguments[0] in VERBS else None
    if helping and called is not None and called.groups:
        print(grouped_help(called, f"clsplat {arguments[0]}", called.groups))
        raise SystemExit(0)
    try:
        with _text_rules(), contextlib.redirect_stderr(boxes), contextlib.nullcontext() if helping else _wide():
            verb = _parsed(arguments, called)
    except SystemExit as error:
        if error.code == 2:
            report(_trouble(arguments, called, _unboxed(boxes.getvalue())), 2, arguments)
        else:
            sys.stderr.write(boxes.getvalue())
        raise
    flags = [word.partition("=")[0][2:].replace("-", "_") for word in arguments if word.startswith("--")]
    return verb.completed({*flags, *(re.sub(r"(^|\.)no_", r"\1", flag) for flag in flags)})


def _parsed(arguments: Sequence[str], called: type[Verb] | None) -> Verb:
    """Let tyro parse a command line. Raises SystemExit after printing an error or the help.

    called: dataclass of the verb that `arguments` begin with; None if they begin with something else.
    """
    # Docstrings of fields are the help. tyro would also look for comments, and tokenize the classes' sources for that.
    config = (HelptextFromCommentsOff,)
    # A completion script lists all verbs.
    completing = any(word.replace("_", "-").startswith("--tyro-") for word in arguments)
    verb: Verb
    if called is not None and not completing:  # tyro needs 10 ms for the other verbs
        verb = tyro.cli(called, args=arguments[1:], prog=f"clsplat {arguments[0]}", config=config)
    else:
        kinds = {name: verb_class(name) if name in arguments else _listed(name) for name in VERBS}
        commands: Any = Union[tuple(Annotated[kind, subcommand(name)] for name, kind in kinds.items())]  # noqa: UP007
        verb = tyro.cli(commands, args=arguments, prog="clsplat", description=PROGRAM_DESCRIPTION, config=config)
    return verb


_TYRO_UNION_ERROR = re.compile(
    r"no type matching \{None\}\|.* could be instantiated from .*\. Got errors: .*- <class '\w+'>: "
)
"""Text that tyro puts before the actual error in its message about a wrong optional number."""


def _trouble(arguments: Sequence[str], called: type[Verb] | None, said: str) -> str:
    """Return the message about a wrong call: unknown flags or verbs with suggestions, else tyro's message.

    called: dataclass of the verb that was called; None for an unknown verb.
    said: tyro's message.
    """
    said = _TYRO_UNION_ERROR.sub("", said)
    if called is not None:
        return unknown_flags(arguments[1:], called, f"clsplat {arguments[0]}") or said
    word = next((word for word in arguments if not word.startswith("-")), "")
    if not word or word in VERBS:
        return said
    if _family(arguments):
        word = " ".join(arguments[:2])
    found = near(word, [*VERBS, *(name.split()[0] for name in VERBS if " " in name)])
    return f"{word} is not a verb, did you mean {found}?" if found else said


def _text_rules() -> tyro.constructors.ConstructorRegistry:
    """Return the rules by which tyro parses a path or a list of steps from one word.

    Lists of steps are written as 500,1000,2000, whereas tyro expects spaces.
    An empty path is an error: it comes from an unset shell variable, and tyro would use the working directory.
    """
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
        raise ValueError(f"{text!r} is not a list of steps, expected numbers such as 500,1000,2000") from None
    return steps


@contextlib.contextmanager
def _wide() -> Iterator[None]:
    """Simulate a wide terminal inside the context, so that tyro does not wrap messages that must be one line."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "10000"
    try:
        yield
    finally:
        del os.environ["COLUMNS"]
        if before is not None:
            os.environ["COLUMNS"] = before


def _unboxed(report: str) -> str:
    """Extract tyro's message from the box that it has drawn: on one line, without the advice below the box's rule."""
    words: list[str] = []
    # if standard output is not UTF-8, tyro draws no box characters, and its first rule is the line below the title
    titled = "╭" in report
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
    """Print an error to standard error. If the command line has --json, also print it as a JSON object to
    standard output. status: the exit status, which goes into this object."""
    tell(f"clsplat: error: {message}")
    if "--json" in arguments:
        print(as_json(message, status), flush=True)


def as_json(message: str, status: int) -> str:
    """Return the JSON object that --json prints for an error. status: the exit status of the command."""
    return json.dumps({"error": message, "status": status})


def tell(line: str) -> None:
    """Print a line to standard error. If it cannot be written, the exit status still reports the error."""
    try:
        print(line, file=sys.stderr, flush=True)
    except OSError:  # discard the line: the interpreter's attempt to write it at exit would change the exit status
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())
