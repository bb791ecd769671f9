# SPDX-License-Identifier: Apache-2.0
"""An OpenCL driver that misbehaves, in every Python process that has this folder on its PYTHONPATH.

CLSPLAT_STAND_IN is HOW FIRST LAST FILE: the texts that are built are numbered from 1, as they are met for the first
time, in FILE, a line of digest and options each, and those from FIRST to LAST come to a bad end: abort, hang, kill, as
the system does where memory is short, memory, as Python says it, or empty, a program without kernels. With launch it is
kernels by name that are numbered, and a launch that aborts.
"""

from __future__ import annotations

import hashlib
import os
import sys
import time
from importlib.abc import MetaPathFinder
from importlib.util import find_spec
from pathlib import Path


def _numbered(text: str, name: str, file: Path) -> tuple[int, bool]:
    """The number of a text, and whether it is new. Processes build one after the other, so the file needs no lock."""
    line = f"{hashlib.sha256(text.encode()).hexdigest()} {name}"
    known = file.read_text().splitlines() if file.exists() else []
    if is_new := line not in known:
        known.append(line)
        file.write_text("\n".join(known))
    return known.index(line) + 1, is_new


def _die(words):
    print(f"driver ERROR: {words}", file=sys.stderr, flush=True)
    os.abort()


def _end_badly(how):
    if how in ("abort", "once"):
        _die("cannot select")
    if how == "hang":
        time.sleep(600)
    if how == "kill":
        os.kill(os.getpid(), 9)
    if how == "memory":
        raise MemoryError


def _misbehave(cl):
    how, first, last, file = os.environ["CLSPLAT_STAND_IN"].split(" ", 3)
    real_build, real_kernels = cl.Program.build, cl.Program.all_kernels
    texts = {}

    def is_doomed(text, name):
        number, is_new = _numbered(text, name, Path(file))
        return int(first) <= number <= int(last) and (is_new or how != "once")

    def build(self, options=(), *args, **kwargs):
        if not hasattr(self, "_source"):
            raise cl.Error("this driver takes no binaries")
        text = " ".join(options) + self._source
        if how == "launch" or not is_doomed(text, " ".join(options)):
            built = real_build(self, options, *args, **kwargs)
            texts[built] = text
            return built
        _end_badly(how)
        return real_build(cl.Program(self._context, "typedef int nothing;"), ["-cl-std=CL1.2"])

    class Launched:
        """A kernel whose launch may abort."""

        def __init__(self, kernel, text):
            self._kernel, self._text = kernel, text

        def __call__(self, *arguments):
            if is_doomed(self._text, self._kernel.function_name):
                _die("cannot generate code")
            return self._kernel(*arguments)

        def __getattr__(self, name):
            return getattr(self._kernel, name)

    def all_kernels(self):
        kernels = real_kernels(self)
        return [Launched(kernel, texts[self]) for kernel in kernels] if how == "launch" else kernels

    cl.Program.build, cl.Program.all_kernels = build, all_kernels


class _Finder(MetaPathFinder):
    """Changes pyopencl when it is imported."""

    def find_spec(self, name, *_):
        if name != "pyopencl":
            return None
        sys.meta_path.remove(self)
        spec = find_spec(name)
        run = spec.loader.exec_module

        def exec_module(module):
            run(module)
            _misbehave(module)

        spec.loader.exec_module = exec_module
        return spec


if "CLSPLAT_STAND_IN" in os.environ:
    sys.meta_path.insert(0, _Finder())
