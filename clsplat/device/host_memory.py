# SPDX-License-Identifier: Apache-2.0
"""Memory of the host for arrays that devices write and programs keep. What is given back is handed out again, as new
pages cost a fault each: those of 20 MB take as long as projecting 100,000 Gaussians."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

ALIGNED = 4096
"""Bytes at multiples of which memory begins, so that no driver works on a copy of it."""
LEAST = 1 << 18
"""Bytes under which it is not worth it."""
MOST = 1 << 28
"""Bytes that wait to be handed out again, at most."""

_lock = threading.Lock()
_idle: list[NDArray[np.uint8]] = []


def host_bytes(count: int) -> NDArray[np.uint8]:
    """(count,) bytes, with anything in them, that begin at a multiple of ALIGNED. They are free when the last array
    over them is gone."""
    size = -(-count // ALIGNED) * ALIGNED
    if size < LEAST:
        return _aligned(np.empty(size + ALIGNED, np.uint8))[:count]
    raw = _found(size + ALIGNED)
    return _aligned(np.asarray(_Block(np.empty(size + ALIGNED, np.uint8) if raw is None else raw)))[:count]


def _found(size: int) -> NDArray[np.uint8] | None:
    # a finalizer that runs within these statements may ask too: it gets new memory, and nobody waits
    if not _lock.acquire(blocking=False):
        return None
    try:
        for place, raw in enumerate(_idle):
            if len(raw) == size:
                return _idle.pop(place)
        return None
    finally:
        _lock.release()


class _Block:
    """Memory that arrays stand on: NumPy keeps it for as long as there is one."""

    def __init__(self, raw: NDArray[np.uint8]) -> None:
        self._raw = raw
        self.__array_interface__: dict[str, Any] = raw.__array_interface__

    def __del__(self) -> None:
        # an array may end within any statement, those under the lock too: then the memory is not kept
        if not _lock.acquire(blocking=False):
            return
        try:
            _idle.append(self._raw)
            while sum(map(len, _idle)) > MOST:
                _idle.pop(0)
        finally:
            _lock.release()


def _aligned(memory: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return memory[-memory.ctypes.data % ALIGNED :]
