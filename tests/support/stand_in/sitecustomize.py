# SPDX-License-Identifier: Apache-2.0
"""An OpenCL driver that misbehaves in every Python process with this folder on its PYTHONPATH.

CLSPLAT_STAND_IN is HOW FIRST LAST FILE. Kernel texts are numbered from 1 in the order of their first builds; FILE has a
line with digest and options for each. The build of the texts FIRST to LAST misbehaves, as HOW says:

- abort: the process aborts. once: only at the first build of a text.
- hang: the build does not return.
- kill: the process is killed, as by a system without free memory.
- memory: Python raises MemoryError.
- empty: the built program has no kernels.
- launch: kernels are numbered instead of texts, with their names in FILE, and their launches abort.
"""

from __future__ import annotations

import hashlib
import os
import sys
import time
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn


def _numbered(text: str, name: str, file: Path) -> tuple[int, bool]:
    """The number of a text, and True if it is new. Processes build one after the other, so the file needs no lock."""
    line = f"{hashlib.sha256(text.encode()).hexdigest()} {name}"
    known = file.read_text().splitlines() if file.exists() else []
    if is_new := line not in known:
        known.append(line)
        file.write_text("\n".join(known))
    return known.index(line) + 1, is_new


def _die(words: str) -> NoReturn:
    print(f"driver ERROR: {words}", file=sys.stderr, flush=True)
    os.abort()


def _end_badly(how: str) -> None:
    if how in ("abort", "once"):
        _die("cannot select")
    if how == "hang":
        time.sleep(600)
    if how == "kill":
        os.kill(os.getpid(), 9)
    if how == "memory":
        raise MemoryError


def _misbehave(cl: Any) -> None:
    how, first, last, file = os.environ["CLSPLAT_STAND_IN"].split(" ", 3)
    real_build, real_kernel, real_enqueue = cl.Program.build, cl.Kernel, cl.enqueue_nd_range_kernel
    texts: dict[Any, str] = {}

    def is_doomed(text: str, name: str) -> bool:
        number, is_new = _numbered(text, name, Path(file))
        return int(first) <= number <= int(last) and (is_new or how != "once")

    def build(self: Any, options: Sequence[str] = (), *args: Any, **kwargs: Any) -> Any:
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

        def __init__(self, kernel: Any, text: str) -> None:
            self._kernel, self._text = kernel, text

        def __call__(self, *arguments: Any) -> Any:
            if is_doomed(self._text, self._kernel.function_name):
                _die("cannot generate code")
            return self._kernel(*arguments)

        def __getattr__(self, name: str) -> Any:
            return getattr(self._kernel, name)

    def enqueue(queue: Any, launched: Any, *arguments: Any) -> Any:
        return real_enqueue(queue, launched._kernel, *arguments)

    cl.Program.build = build
    if how == "launch":
        cl.Kernel = lambda program, name: Launched(real_kernel(program, name), texts[program])
        cl.enqueue_nd_range_kernel = enqueue


class _Finder(MetaPathFinder):
    """Changes pyopencl when it is imported."""

    def find_spec(self, name: str, *_: object) -> ModuleSpec | None:
        if name != "pyopencl":
            return None
        sys.meta_path.remove(self)
        spec = find_spec(name)
        assert spec is not None and spec.loader is not None
        run = spec.loader.exec_module

        def exec_module(module: ModuleType) -> None:
            run(module)
            _misbehave(module)

        vars(spec.loader)["exec_module"] = exec_module
        return spec


if "CLSPLAT_STAND_IN" in os.environ:
    sys.meta_path.insert(0, _Finder())
