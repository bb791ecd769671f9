# SPDX-License-Identifier: Apache-2.0
"""Helpers of the tools that measure: sizes, a result's record of the machine, messages of trouble."""

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


def options_parser(description: str | None, repeat: int = 5, *, plot: bool = True) -> argparse.ArgumentParser:
    """Parser with the options of every tool that measures; the description stands as it is written."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--repeat", metavar="N", type=int, default=repeat)
    parser.add_argument("--device")
    parser.add_argument("--json", action="store_true")
    if plot:
        parser.add_argument("--plot", metavar="FILE", type=Path)
    return parser


def parsed(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> argparse.Namespace:
    """Parsed options. Raises InputError for fewer than one repetition and a plot that cannot be drawn."""
    options = parser.parse_args(arguments)
    require(options.repeat >= 1, f"--repeat {options.repeat}: expected at least 1")
    if getattr(options, "plot", None) is not None:
        check_plot(options.plot)
    return options


def number(text: str) -> int:
    """An integer that may be written as 3e7; for argparse, which tells of a ValueError."""
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
    """Record of the machine that every figure needs beside it."""
    return {
        "device": device.name,
        "driver": device.driver,
        "shape": {name: getattr(device.shape, name) for name in ("lanes", "items", "by_gaussian", "subgroups")},
        "repeat": repeat,
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    }


def heading(result: Result) -> str:
    """`machine` in a line."""
    load = f"load average {result['load_average'] or 0:.1f}"
    shape = Shape(**result["shape"], chunks=1).words
    driver = result["driver"].split("  ")[0]
    return f"{result['device']}, {driver}, {shape}; medians of {result['repeat']}; {load}"


def show(result: Result, lines: Sequence[str], *, as_json: bool) -> None:
    """The result on standard output, for programs or for people."""
    print(json.dumps(result, indent=2) if as_json else "\n".join([heading(result), "", *lines]))


def tool(name: str) -> Callable[[Callable[[Sequence[str]], int]], Callable[[Sequence[str]], int]]:
    """Decorator of a tool's main function, which tells trouble in one line as the command line does."""

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
