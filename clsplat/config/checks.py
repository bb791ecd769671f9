# SPDX-License-Identifier: Apache-2.0
"""Checks of settings' ranges and types, with the error message for the flag, and parsing of memory sizes."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from math import inf
from numbers import Integral, Real
from typing import Any, Literal, get_args, get_origin, get_type_hints

from clsplat.errors import InputError

WHOLE_NUMBER_LIMIT = 1 << 62
"""Whole numbers must be smaller than this in magnitude, so that config.toml can hold them."""
_BYTE_SIZE_PATTERN = re.compile(r"\s*([0-9]+(?:\.[0-9]*)?|\.[0-9]+)\s*([kmgt]?)(i?b)?\s*", re.IGNORECASE)
"""Pattern of a memory size such as 1.5GiB. Its groups are the number, the prefix (k, m, g or t) and the ending."""
Rule = tuple[tuple[str, ...], Callable[[float], bool], str]
"""Rule for settings: names of the settings, a predicate that is True for valid values and False for NaN, and the
expectation in words."""


def check_rules(config: object, prefix: str, rules: tuple[Rule, ...]) -> None:
    """Raise InputError for the first setting of `config` that breaks its rule, naming its flag.

    prefix: beginning of the settings' flags, such as "--density.".
    """
    for names, makes_sense, expected in rules:
        for name in names:
            value = getattr(config, name)
            if not makes_sense(value):
                raise InputError(f"{prefix}{name.replace('_', '-')} {value}: expected {expected}")


def check_kinds(config: object, prefix: str) -> None:
    """Raise InputError for the first setting of `config` that has the wrong type or is too large for config.toml.

    prefix: beginning of the settings' flags, such as "--density.".
    """
    for name, kind in get_type_hints(type(config)).items():
        value = getattr(config, name)
        if expected := misfit(kind, value):
            text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
            raise InputError(f"{prefix}{name.replace('_', '-')} {text:.100}: expected {expected}")


def misfit(kind: Any, value: object) -> str | None:
    """Return in words which values a setting of the type `kind` may have, or None if `value` is one of these."""
    if get_origin(kind) is Literal:
        fits, expected = isinstance(value, str) and value in get_args(kind), f"one of {', '.join(get_args(kind))}"
    elif get_origin(kind) is tuple:
        fits = isinstance(value, tuple | list) and all(_is_whole(step) for step in value)
        expected = f"whole numbers below {WHOLE_NUMBER_LIMIT}"
    elif kind is int:
        fits, expected = _is_whole(value), f"a whole number below {WHOLE_NUMBER_LIMIT}"
    elif kind is float:
        fits = isinstance(value, Real) and not _is_truth(value) and not 1e300 <= abs(value) < inf  # type: ignore[operator]
        expected = "a number below 1e300"
    elif kind is str:
        fits, expected = isinstance(value, str), "text"
    else:
        fits = _is_truth(value) if kind is bool else isinstance(value, kind)
        expected = "True or False" if kind is bool else f"{kind.__name__}(...)"
    return None if fits else expected


def _is_truth(value: object) -> bool:
    return type(value).__name__ in ("bool", "bool_")  # NumPy's Boolean type is named bool_ before version 2


def _is_whole(value: object) -> bool:
    return isinstance(value, Integral) and not _is_truth(value) and abs(int(value)) < WHOLE_NUMBER_LIMIT


def check_steps(flag: str, steps: tuple[int, ...]) -> None:
    """Raise InputError, naming `flag`, unless all steps are at least 1 and each is larger than the one before."""
    if any(step < 1 for step in steps) or list(steps) != sorted(set(steps)):
        raise InputError(f"{flag} {','.join(map(str, steps))}: expected steps of at least 1, in ascending order")


def parse_bytes(text: str | int | None, flag: str = "--max-device-mem") -> int | None:
    """Parse "256MiB", "2GiB", "1.5G" (the same as GiB), "500MB" (decimal) or a number to bytes. None stays None.

    flag: flag that the text was given by, for the message of InputError.
    """
    if text is None:
        return None
    match = _BYTE_SIZE_PATTERN.fullmatch(str(text))
    size = 0
    if match is not None:
        number, prefix, ending = match.groups()
        base, power = 1000 if (ending or "").lower() == "b" else 1024, ["", *"kmgt"].index(prefix.lower())
        size = int(float(number) * base**power)
    if size < 1:
        raise InputError(f"{flag} {text}: expected a size such as 256MiB, 1.5G or a number of bytes")
    return size


def device_names(selector: str | None) -> list[str]:
    """Return the names of devices, separated by commas, in `selector` or else in CLSPLAT_DEVICE; [""] if neither is
    given."""
    text = selector or os.environ.get("CLSPLAT_DEVICE") or ""
    return [name.strip() for name in text.split(",") if name.strip()] or [text]
