# SPDX-License-Identifier: Apache-2.0
"""Building of OpenCL programs from kernel files: source text, defines and options, compilation, built kernels."""

from __future__ import annotations

import hashlib
import os
import secrets
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from math import prod
from typing import Any

import pyopencl as cl

from clsplat.device.drivers import binary_cache
from clsplat.device.drivers.driver_records import BREAK_KERNEL_VARIABLE
from clsplat.device.drivers.quirks import build_advice
from clsplat.device.source import kernel_root, kernel_source
from clsplat.errors import DriverError, InputError, KernelBuildError, examples


@dataclass(frozen=True)
class Variant:
    """A kernel file's name (without .cl) and text, and the options to build it."""

    stem: str
    source: str
    options: tuple[str, ...]

    @cached_property
    def digest(self) -> str:
        """Hexadecimal digest that identifies the text and options."""
        text = "\0".join((self.stem, self.source, *self.options))
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def anew(self, salt: str) -> Variant:
        """Copy this variant, with a text that no driver has in its cache, as the cached build may be damaged.

        salt: random hexadecimal digits, added to the text in the name of a typedef; "" adds nothing. A comment would
        not do, because PoCL's cache is keyed by the preprocessor's output.
        """
        return replace(self, source=f"{self.source}typedef int anew_{salt};\n") if salt else self


def variant_of(stem: str, defines: Mapping[str, object], options: str) -> Variant:
    """Return the variant of `stem`.cl with these defines and options. Raises InputError like `text_of`."""
    flags = [f"-D{name}" if value is True else f"-D{name}={value}" for name, value in sorted(defines.items())]
    return Variant(stem, text_of(stem), (*flags, *options.split()))


def text_of(stem: str) -> str:
    """Return the source of `stem`.cl, modified as CLSPLAT_BREAK_KERNEL says. Raises InputError for an invalid value."""
    source = kernel_source(stem)
    wanted = os.environ.get(BREAK_KERNEL_VARIABLE)
    if not wanted:
        return source
    where, _, change = wanted.partition(":")
    old, arrow, new = (part.strip() for part in change.partition("=>"))
    if not (where and old and arrow):
        raise InputError(f"{BREAK_KERNEL_VARIABLE}={wanted}: expected STEM: OLD => NEW")
    stems = sorted(path.stem for path in kernel_root().glob("*.cl"))
    if where.strip() not in stems:
        raise InputError(
            f"{BREAK_KERNEL_VARIABLE}={wanted}: {where.strip()} is not a kernel, expected one of {examples(stems)}"
        )
    if where.strip() != stem:
        return source
    if old not in source:
        raise InputError(f"{BREAK_KERNEL_VARIABLE}={wanted}: {stem}.cl does not contain {old}")
    return source.replace(old, new)


def build(context: cl.Context, device: cl.Device, variant: Variant) -> tuple[cl.Program, str]:
    """Compile a kernel file. Returns the program, and the salt that its build needed: a random text added to the source
    (`Variant.anew`), usually empty.

    A failed build is repeated once, with a salt. PoCL's cache has two faults: it may hold a program without kernels
    from an aborted build, and another process may remove files of a build under way.

    Raises KernelBuildError with the device, options, log and source; and DriverError for a program without kernels.
    """
    if (saved := binary_cache.load(context, device, variant.digest, variant.options)) is not None:
        return saved, ""
    salt = ""
    try:
        program = _compiled(context, device, variant)
    except KernelBuildError:
        program = None
    if program is None or program.num_kernels == 0:
        salt = secrets.token_hex(8)
        program = _compiled(context, device, variant.anew(salt))
    if program.num_kernels == 0:
        raise DriverError(f"{device.name.strip()}: {variant.stem}.cl has no kernels after the driver has built it")
    binary_cache.save(device, variant.digest, program)
    return program, salt


def _compiled(context: cl.Context, device: cl.Device, variant: Variant) -> cl.Program:
    source = variant.source
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", cl.CompilerWarning)
            return cl.Program(context, source).build(options=list(variant.options))
    except cl.Error as error:
        numbered = "\n".join(f"{number:4d}  {line}" for number, line in enumerate(source.splitlines(), 1))
        log = str(error)
        first = next((line.strip() for line in log.splitlines() if "error:" in line), log.splitlines()[0])
        raise KernelBuildError(
            f"{variant.stem}.cl does not build on {device.name.strip()} with {' '.join(variant.options)}: {first} "
            f"({build_advice(log)})",
            log,
            numbered,
        ) from None


def kernels_of(program: cl.Program) -> dict[str, cl.Kernel]:
    """Return the kernels of a built program, by name.

    `Program.all_kernels` would leak them: pyopencl 2026.1 retains each kernel twice and releases it once, so that the
    driver keeps the kernel and the program for ever.
    """
    names: str = program.get_info(cl.program_info.KERNEL_NAMES)
    return {name: cl.Kernel(program, name) for name in names.split(";")}


class Kernel:
    """A built kernel.

    cl_kernel: pyopencl's kernel. The first launch sets the types of its scalar arguments, because without them each
        scalar costs 10 microseconds per launch.
    tried: the kinds of launch (suffixes from `launch.form_of`) that the sandbox has tried.
    spare: kernel objects of dropped command buffers, for new command buffers.
    """

    def __init__(self, variant: Variant, program: cl.Program, kernel: Any) -> None:
        self.variant, self.program = variant, program
        self.spare: list[Any] = []
        self.name: str = kernel.function_name
        self.cl_kernel = kernel
        self.tried: set[str] = set()

    def most_items(self, device: cl.Device) -> int:
        """Maximum work-items in a group of this kernel: what the driver reports, or its `reqd_work_group_size`.

        Returns the larger of the two, as NVIDIA's driver reports 256 even for kernels that it has built for 1024.
        """
        info = cl.kernel_work_group_info
        reported: int = self.cl_kernel.get_work_group_info(info.WORK_GROUP_SIZE, device)
        built_for: list[int] = self.cl_kernel.get_work_group_info(info.COMPILE_WORK_GROUP_SIZE, device)
        return max(reported, prod(built_for))


class Kernels:
    """The built kernels of a kernel file with certain defines. Each kernel is an attribute, by its name."""

    def __init__(self, variant: Variant, program: cl.Program) -> None:
        self._kernels = {name: Kernel(variant, program, kernel) for name, kernel in kernels_of(program).items()}

    def __getattr__(self, name: str) -> Kernel:
        try:
            return self._kernels[name]
        except KeyError:
            raise AttributeError(f"no kernel {name}, expected one of {', '.join(self._kernels)}") from None
