# SPDX-License-Identifier: Apache-2.0
"""Helpers of the measuring tools: sizes, the description of the machine in a result, error messages."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any

from clsplat.bench.plots import check_plot
from clsplat.device.context import Device
from clsplat.device.drivers.shapes import Shape
from clsplat.errors import ClsplatError, InputError

Result = dict[str, Any]


def plain_parser(description: str | None, **options: Any) -> argparse.ArgumentParser:
    """Parser whose help keeps the line breaks of the description."""
    lines = argparse.RawDescriptionHelpFormatter
    return argparse.ArgumentParser(description=description, formatter_class=lines, allow_abbrev=False, **options)


def options_parser(description: str | None, repeat: int = 5, *, plot: bool = True) -> argparse.ArgumentParser:
    """Parser with the common options of the measuring tools."""
    parser = plain_parser(description)
    parser.add_argument("--repeat", metavar="N", type=int, default=repeat)
    parser.add_argument("--device")
    parser.add_argument("--json", action="store_true")
    if plot:
        parser.add_argument("--plot", metavar="FILE", type=Path)
    return parser


def parsed(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> argparse.Namespace:
    """Parse the options. Raises InputError for less than one repetition, and for a plot that cannot be drawn."""
    options = parser.parse_args(arguments)
    require(options.repeat >= 1, f"--repeat {options.repeat}: expected at least 1")
    if getattr(options, "plot", None) is not None:
        check_plot(options.plot)
    return options


def number(text: str) -> int:
    """An integer that may be written as 3e7. For argparse, which reports a ValueError."""
    try:
        return int(float(text))
    except OverflowError:
        raise ValueError(text) from None


def sizes(first: int, most: int) -> list[int]:
    """first, 3 first, 10 first, 30 first and so on, up to `most`."""
    found = [factor * first * 10**power for power in range(12) for factor in (1, 3)]
    return [size for size in found if size <= most]


def require(condition: bool, message: str) -> None:
    """Raise InputError unless the condition holds."""
    if not condition:
        raise InputError(message)


def machine(device: Device, repeat: int) -> Result:
    """Description of the machine, for the record of a measurement."""
    return {
        "device": device.name,
        "driver": device.driver,
        "shape": {name: getattr(device.shape, name) for name in ("lanes", "items", "by_gaussian", "subgroups")},
        "repeat": repeat,
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    }


def heading(result: Result) -> str:
    """The description by `machine` in one line."""
    load = f"load average {result['load_average'] or 0:.1f}"
    shape = Shape(**result["shape"], chunks=1).words
    driver = result["driver"].split("  ")[0]
    return f"{result['device']}, {driver}, {shape}; medians of {result['repeat']}; {load}"


def show(result: Result, lines: Sequence[str], *, as_json: bool) -> None:
    """Print the result as JSON or as text."""
    print(json.dumps(result, indent=2) if as_json else "\n".join([heading(result), "", *lines]))


def tool(name: str) -> Callable[[Callable[[Sequence[str]], int]], Callable[[Sequence[str]], int]]:
    """Decorator of a tool's main function. It reports errors in one line and returns a status, as `clsplat` does."""

    def decorated(work: Callable[[Sequence[str]], int]) -> Callable[[Sequence[str]], int]:
        @wraps(work)
        def main(arguments: Sequence[str]) -> int:
            try:
                return work(arguments)
            except (ClsplatError, OSError, MemoryError) as error:
                print(f"{name}: error: {' '.join(str(error).split()) or type(error).__name__}", file=sys.stderr)
                return error.exit_status if isinstance(error, ClsplatError) else 1
            except KeyboardInterrupt:
                print(f"{name}: interrupted", file=sys.stderr)
                return 130

        return main

    return decorated
