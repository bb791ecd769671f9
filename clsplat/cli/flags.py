# SPDX-License-Identifier: Apache-2.0
"""Flags of a verb, read from its dataclass: grouped help, and suggestions for misspelt flags.

tyro makes and parses the flags themselves (`parse` in `clsplat/cli/parsing.py`). The names here must be the same as
tyro's.
"""

from __future__ import annotations

import ast
import dataclasses
import difflib
import inspect
import shutil
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from tyro.conf import FlagCreatePairsOff, Positional, Suppress

Groups = tuple[tuple[str, tuple[str, ...]], ...]
"""Groups of flags in a verb's help. Each has a title and the names of its flags, or patterns that end in `*`. A flag is
listed in the first group that matches it."""
OTHER_FLAGS_TITLE = "Others"
"""Title of the group for flags that match no other group."""
HELP_TEXT_COLUMN = 24
"""Column at which help texts begin. If a flag's name is longer, its text begins on the next line."""
MIN_FLAG_SIMILARITY = 0.75
"""Smallest similarity, from 0 to 1, at which a known flag is suggested for an unknown one."""
_METAVARS = {int: "INT", float: "FLOAT", str: "STR"}
"""Placeholder of a flag's value in the help, by the value's type."""


@dataclass(frozen=True)
class Option:
    """A flag, or a positional argument.

    names: the flag's names on the command line; empty for a positional argument.
    text: the help of the annotation, else the docstring of the dataclass field.
    off: name of the flag that sets this one to False, such as "--no-report"; empty if there is no such flag.
    """

    names: tuple[str, ...]
    metavar: str
    text: str
    default: Any = None
    required: bool = False
    off: str = ""

    @property
    def key(self) -> str:
        """The flag's long name without its leading hyphens; for a positional argument, its metavar."""
        return self.names[-1].removeprefix("--") if self.names else self.metavar

    @property
    def told(self) -> str:
        """Help text, followed by "(required)", or by the default value unless that is None, False or empty."""
        silent = self.default is None or self.default is False or self.default in ("", ())
        if self.required:
            return f"{self.text} (required)"
        return self.text if silent else f"{self.text} (default: {_shown(self.default)})"


def options(kind: type, prefix: str = "") -> Iterator[Option]:
    """Yield the flags of a dataclass and its nested dataclasses, in the order of the fields.

    prefix: beginning of the flags' names, such as "rasterizer."; "" for a verb.
    """
    hints, texts = get_type_hints(kind, include_extras=True), _docstrings(kind)
    for field in dataclasses.fields(kind):
        hint, conf = hints[field.name], _conf(hints[field.name])
        name = getattr(conf, "name", None)
        bare = _bare(hint)
        if _marker(Suppress) in _metadata(hint):
            continue
        if isinstance(bare, type) and dataclasses.is_dataclass(bare):
            within = field.name if name is None else name
            yield from options(bare, f"{prefix}{within}." if within else prefix)
            continue
        long = (prefix + (name or field.name)).replace("_", "-")
        positional = _marker(Positional) in _metadata(hint)
        pairs = bare is bool and _marker(FlagCreatePairsOff) not in _metadata(hint)
        *parents, last = long.split(".")
        default, required = field.default, field.default is dataclasses.MISSING
        names = () if positional else (*(getattr(conf, "aliases", None) or ()), f"--{long}")
        metavar = getattr(conf, "metavar", None) or ("" if bare is bool else _metavar(bare, long))
        off = ".".join([*parents, f"no-{last}"]) if pairs else ""
        text = getattr(conf, "help", None) or texts.get(field.name, "")
        yield Option(names, metavar, text, None if required else default, required, off and f"--{off}")


def grouped_help(kind: type, prog: str, groups: Groups, width: int | None = None) -> str:
    """Return the help text of a verb, with its flags in groups.

    kind: dataclass of the verb's arguments.
    prog: the call that usage shows, such as "clsplat render".
    groups: titles of the groups, and the flags in each.
    width: characters in a line; by default the terminal's width, at most 100.
    """
    width = min(width or shutil.get_terminal_size().columns, 100)
    every = list(options(kind))
    placed: dict[str, list[Option]] = {title: [] for title in (*(title for title, _ in groups), OTHER_FLAGS_TITLE)}
    for option in every:
        title = next(
            (title for title, names in groups if any(fnmatchcase(option.key, name) for name in names)),
            OTHER_FLAGS_TITLE,
        )
        placed[title].append(option)
    for title, names in groups:  # sort flags in the order in which `groups` names them
        order = {option.key: index for index, name in enumerate(names) for option in every if option.key == name}
        placed[title].sort(key=lambda option: order.get(option.key, len(every)))
    wanted = [option for option in every if option.required]
    usage = " ".join(f"{(*option.names, '')[0]} {option.metavar}".strip() for option in wanted)
    lines = [f"usage: {prog} {usage} [OPTIONS]", "", *textwrap.wrap(inspect.getdoc(kind) or "", width)]
    for title, entries in placed.items():
        if entries:
            lines += ["", f"{title}:", *(line for option in entries for line in _lines(option, width))]
    return "\n".join([*lines, "", f"  {'-h, --help':{HELP_TEXT_COLUMN - 2}}Show this help."])


def unknown_flags(arguments: Sequence[str], kind: type, prog: str) -> str:
    """Return a one-line message about unknown flags, with similar names; empty if all flags are known.

    arguments: words of the command line after the verb.
    kind: dataclass of the verb's arguments.
    prog: the call that the message shows, such as "clsplat render".
    """
    known = ["--help", "--help-verbose"]
    for option in options(kind):
        known += [*option.names, option.off] if option.off else option.names
    given = dict.fromkeys(word.partition("=")[0] for word in arguments if word.startswith("--") and word != "--")
    wrong = [word for word in given if word.replace("_", "-") not in known]
    told = [
        f"{word} is not a flag, " + (f"did you mean {found}?" if (found := near(word, known)) else "") for word in wrong
    ]
    return " ".join(f"{text}expected one of {prog} --help;" if text.endswith(" ") else text for text in told).rstrip(
        ";"
    )


def near(word: str, known: Sequence[str]) -> str:
    """Find the known name that is most similar to a word; empty if none is similar enough."""
    plain = {name.lower().replace("_", "-").replace("colour", "color"): name for name in known}
    meant = word.lower().replace("_", "-").replace("colour", "color")
    # the word may be the beginning of a name, such as --shutter, or the part after a dot, such as --fps
    parts = [name for name in plain if name.endswith(f".{meant[2:]}") or name.startswith(f"{meant}-")]
    found = parts or difflib.get_close_matches(meant, plain, 1, MIN_FLAG_SIMILARITY)
    return plain[found[0]] if found and len(meant.lstrip("-")) > 2 else ""


def _lines(option: Option, width: int) -> Iterator[str]:
    head = "  " + f"{', '.join(option.names)} {option.metavar}".strip()
    told = textwrap.wrap(" ".join(option.told.split()), width - HELP_TEXT_COLUMN, break_on_hyphens=False)
    if len(head) > HELP_TEXT_COLUMN - 2:
        yield head
    elif told:
        yield f"{head:{HELP_TEXT_COLUMN}}{told.pop(0)}"
    for line in told:
        yield f"{'':{HELP_TEXT_COLUMN}}{line}"


def _shown(value: object) -> str:
    return (
        ",".join(map(str, value))
        if isinstance(value, tuple)
        else f"{value:.6g}"
        if isinstance(value, float)
        else str(value)
    )


def _marker(marked: Any) -> Any:
    """The marker that an annotation of tyro, such as Positional, adds to a type."""
    return get_args(marked[int])[1]


def _metadata(hint: Any) -> tuple[Any, ...]:
    return tuple(get_args(hint)[1:]) if get_origin(hint) is Annotated else ()


def _conf(hint: Any) -> Any:
    """The settings that tyro's `arg` adds to a field's annotation, or None if it has no `arg`."""
    return next((each for each in _metadata(hint) if hasattr(each, "metavar")), None)


def _bare(hint: Any) -> Any:
    """The type of a field's values, without tyro's annotations and without None."""
    while get_origin(hint) is Annotated:
        hint = get_args(hint)[0]
    if get_origin(hint) in (Union, UnionType):
        rest = [each for each in get_args(hint) if each is not type(None)]
        return _bare(rest[0]) if len(rest) == 1 else Union[tuple(rest)]  # noqa: UP007
    return hint


def _metavar(bare: Any, name: str) -> str:
    if get_origin(bare) is Literal:
        return "|".join(map(str, get_args(bare)))
    return _METAVARS.get(bare, name.rpartition(".")[2].upper())


def _docstrings(kind: type) -> dict[str, str]:
    """Return the docstring of each field of a dataclass, from the source of the class or its nearest base class.

    The result is empty if the source code is not available.
    """
    texts: dict[str, str] = {}
    for each in reversed(kind.__mro__):
        if not dataclasses.is_dataclass(each):
            continue
        try:
            (tree,) = ast.parse(textwrap.dedent(inspect.getsource(each))).body
        except (OSError, TypeError, SyntaxError):
            continue
        assert isinstance(tree, ast.ClassDef)
        for field, text in zip(tree.body, tree.body[1:], strict=False):
            if (
                isinstance(field, ast.AnnAssign)
                and isinstance(field.target, ast.Name)
                and isinstance(text, ast.Expr)
                and isinstance(text.value, ast.Constant)
            ):
                texts[field.target.id] = str(text.value.value)
    return texts
