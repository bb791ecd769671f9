# SPDX-License-Identifier: Apache-2.0
"""Replacements that the memory check's search for uninitialised reads needs with Oclgrind 21.10."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clsplat.device import buffers, program
from clsplat.device.buffers import DeviceArray
from clsplat.device.source import kernel_source

STAND_INS = (
    "arrays are filled by a copy from the host, as what clEnqueueFillBuffer writes counts as uninitialised there",
    "rows and views are written with the whole of their buffer, as its shadow of a write begins where that does",
    "no buffer is released, as what is written to memory that is used again counts as uninitialised at times",
    "vectors made of shorter vectors are made of their elements, as its shadow of such a shuffle reads past the end",
    "the padding of an image gradient is masked by a choice in each lane, as its shadow of x & 0 is that of x",
)
"""Differences of the check of uninitialised reads from the product, and the reasons. What is not replaced here is
found: each is the cause of a crash or of findings."""


def stand_in(lanes: int) -> None:
    """Replace what STAND_INS lists. lanes: those of the shape that is checked."""
    kept = []

    class Kept(buffers._Buffer):  # noqa: SLF001
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            kept.append(self)

    def fill(self: DeviceArray, value: float) -> None:
        self.set(np.full(self.shape, value, self.dtype))

    write_from_start = DeviceArray._write  # noqa: SLF001

    def write(self: DeviceArray, values: NDArray[Any], start: int) -> None:
        offset = self.buffer.get_info(cl.mem_info.OFFSET) + self._at(start)
        if offset == 0 or values.size == 0:
            write_from_start(self, values, start)
            return
        whole = self.buffer.get_info(cl.mem_info.ASSOCIATED_MEMOBJECT) or self.buffer
        host = np.empty(whole.get_info(cl.mem_info.SIZE), np.uint8)
        cl.enqueue_copy(self.device.queue, host, whole)
        written = np.frombuffer(np.ascontiguousarray(values, self.dtype).tobytes(), np.uint8)
        host[offset : offset + written.size] = written
        cl.enqueue_copy(self.device.queue, whole, host)

    DeviceArray._write = write  # type: ignore[method-assign]  # noqa: SLF001
    buffers._Buffer = Kept  # type: ignore[misc]  # noqa: SLF001
    DeviceArray.fill = fill  # type: ignore[method-assign]
    vars(program)["kernel_source"] = lambda stem: by_elements(kernel_source(stem), lanes)


def by_elements(source: str, lanes: int) -> str:
    """Kernel source in which vectors are made of elements: (float8)(a.s0, a.s1, ...) instead of (float8)(a.lo, ...).

    LOAD_CELL and the mask of image gradients are replaced likewise. Every line keeps its number.
    lanes: those of the shape.
    """
    parts = r"\w+\.(?:lo|hi|s[0-9a-f]{2,8})"
    halves = {"lo": "0123", "hi": "4567"}

    def elements(match: re.Match[str]) -> str:
        pieces = [part.strip().split(".") for part in match[2].split(",")]
        each = [f"{name}.s{i}" for name, which in pieces for i in halves.get(which, which[1:])]
        return f"({match[1]})({', '.join(each)})"

    def masked(match: re.Match[str]) -> str:
        at = f"({match[1]})"
        if lanes == 1:
            return f"(inside ? *{at} : 0.0f)"
        each = [f"inside.s{4 * row + i} ? {at}[{row} * stride + {i}] : 0.0f" for row in range(2) for i in range(4)]
        return f"(floatL)({', '.join(each)})"

    source = re.sub(rf"\((float8|int8)\)\(({parts}(?:, {parts})+)\)", elements, source)
    gradient = r"AS_FLOATL\(LOAD_CELL\(int, \(__global const int \*\)(image_gradient[^,]*), stride\) & inside\)"
    source = re.sub(gradient, masked, source)
    source = source.replace(
        "#define LANES 16\n", "#define LANES 8\n"
    )  # for the loss: two vectors of 8 floats give the same as one of 16
    loads = "((type##8)(LOAD4(type, p), LOAD4(type, (p) + (stride))))"
    each = [f"(p)[{i}]" for i in range(4)] + [f"(p)[(stride) + {i}]" for i in range(4)]
    return source.replace(loads, f"((type##8)({', '.join(each)}))")
