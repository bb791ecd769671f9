# SPDX-License-Identifier: Apache-2.0
"""Builds kernels, once per source and set of defines."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from typing import Any

import pyopencl as cl

from clsplat.device.source import kernel_source
from clsplat.errors import InputError, KernelBuildError

BREAK = "CLSPLAT_BREAK_KERNEL"
"""For the tests of `clsplat selftest` alone: STEM: WORDS => WORDS replaces words of one kernel's text, as a driver that
miscompiles an operation would."""


def _broken(stem: str, source: str) -> str:
    """The source, or what BREAK makes of it. Raises InputError where that makes no sense."""
    wanted = os.environ.get(BREAK)
    if not wanted:
        return source
    where, _, change = wanted.partition(":")
    old, arrow, new = (part.strip() for part in change.partition("=>"))
    if not (where and old and arrow):
        raise InputError(f"{BREAK}={wanted}: expected STEM: WORDS => WORDS")
    if where.strip() != stem:
        return source
    if old not in source:
        raise InputError(f"{BREAK}={wanted}: {stem}.cl has no such words")
    return source.replace(old, new)


def build(context: cl.Context, device: cl.Device, stem: str, defines: Mapping[str, object], options: str) -> cl.Program:
    """Compile `stem`.cl. Raises KernelBuildError with the device, the options, the log and the source."""
    source = _broken(stem, kernel_source(stem))
    flags = [f"-D{name}" if value is True else f"-D{name}={value}" for name, value in sorted(defines.items())]
    all_options = [*flags, *options.split()]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", cl.CompilerWarning)
            return cl.Program(context, source).build(options=all_options)
    except cl.Error as error:
        numbered = "\n".join(f"{number:4d}  {line}" for number, line in enumerate(source.splitlines(), 1))
        log = str(error)
        first = next((line.strip() for line in log.splitlines() if "error:" in line), log.splitlines()[0])
        raise KernelBuildError(
            f"{stem}.cl does not build on {device.name.strip()} with {' '.join(all_options)}: {first} "
            "(CLSPLAT_DEBUG=1 shows the log and the source)",
            log,
            numbered,
        ) from None


class Kernels:
    """The kernels of one source file with one set of defines, by name; each kernel object is made once."""

    def __init__(self, program: cl.Program) -> None:
        self._kernels: dict[str, Any] = {kernel.function_name: kernel for kernel in program.all_kernels()}

    def __getattr__(self, name: str) -> Any:
        try:
            return self._kernels[name]
        except KeyError:
            raise AttributeError(f"no kernel {name}; there are {', '.join(self._kernels)}") from None
