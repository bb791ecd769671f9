# SPDX-License-Identifier: Apache-2.0
"""Compile the kernels with Intel's offline compiler for its GPUs: items that run in step, and use of memory.

Instructions are not counted. `ocloc` must be on the path; it is in Debian's intel-opencl-icd, from 2022.
"""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from gpu_compilers import NoCompilerError, Source, run_checked

from clsplat.device.source import kernel_source
from clsplat.errors import ClsplatError

INTEL = {"tgllp": "Xe-LP", "dg2-g10": "Arc A770"}
"""Devices, by their names in ocloc."""


@dataclass(frozen=True)
class IntelBuilt:
    """A kernel compiled for a device.

    step: work-items that run in step.
    stack: bytes per work-item, including spills.
    shared: bytes per group.
    """

    source: Source
    kernel: str
    device: str
    step: int
    stack: int
    shared: int


def ocloc() -> str | None:
    """Path of ocloc, or None."""
    return shutil.which("ocloc")


def compile_intel(source: Source, device: str) -> list[IntelBuilt]:
    """Compile a kernel file. Raises ClsplatError if the compiler refuses it."""
    program, what = ocloc(), f"{source.label} for {device}"
    if program is None:
        raise NoCompilerError("no ocloc found: apt install intel-opencl-icd")
    with tempfile.TemporaryDirectory(prefix="clsplat-intel-") as scratch:
        text = Path(scratch) / f"{source.stem}.cl"
        text.write_text(kernel_source(source.stem), encoding="utf-8")
        options = ("-options", " ".join(source.common), "-internal_options", "-cl-intel-allow-zebin")
        place = ("-output_no_suffix", "-out_dir", scratch)
        run_checked([program, "compile", "-q", "-file", str(text), "-device", device, *options, *place], what)
        return read_intel(source, device, (Path(scratch) / source.stem).read_bytes())


def read_intel(source: Source, device: str, binary: bytes) -> list[IntelBuilt]:
    """Kernels, from the description in a binary. Raises ClsplatError if there is none."""
    start = binary.find(b"---\nversion:")
    if start < 0:
        raise ClsplatError(f"{source.label} for {device}: the binary of ocloc does not describe its kernels")
    told = binary[start : binary.index(b"\0", start)].decode("utf-8", "replace").partition("kernels_misc_info:")[0]
    found = []
    for entry in re.split(r"^  - name: +", told, flags=re.MULTILINE)[1:]:
        name, _, rest = entry.partition("\n")
        numbers = {key: int(value) for key, value in re.findall(r"^ +(\w+): +(\d+)$", rest, re.MULTILINE)}
        step = numbers["simd_size"]
        memory = re.findall(r"usage: +\w+\n +size: +(\d+)(\n +is_simt_thread: +true)?", rest)
        stack = sum(int(size) if of_item else int(size) // step for size, of_item in memory)
        found.append(IntelBuilt(source, name.strip("'\" "), device, step, stack, numbers.get("slm_size", 0)))
    return found


def compiled_for_intel(sources: Iterable[Source], jobs: int, say: Callable[[str], None]) -> list[IntelBuilt]:
    """Compile every source for every device. Raises ClsplatError. say: prints progress."""
    asked = [(source, device) for device in INTEL for source in sources]
    say(f"{len(asked)} kernel files to compile for Intel")
    with ThreadPoolExecutor(jobs) as pool:
        return [built for kernels in pool.map(lambda each: compile_intel(*each), asked) for built in kernels]
