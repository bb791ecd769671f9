# SPDX-License-Identifier: Apache-2.0
"""Allocator of page-aligned host memory for arrays that a device writes and callers keep.

Freed memory is reused, because each new page costs a page fault. For 20 MB the page faults take as long as the
projection of 100,000 Gaussians.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

HOST_ALIGNMENT_BYTES = 4096
"""Alignment of the memory in bytes. Drivers use memory with this alignment in place instead of copying it."""
MIN_RECYCLED_BYTES = 1 << 18
"""Minimum size in bytes of a block that is kept for reuse. For smaller blocks, reuse saves no time."""
MAX_IDLE_BYTES = 1 << 28
"""Maximum bytes of all freed blocks together that are kept for reuse."""

_lock = threading.Lock()
_idle: list[NDArray[np.uint8]] = []


def host_bytes(count: int) -> NDArray[np.uint8]:
    """Allocate an uninitialised array (count,), aligned to HOST_ALIGNMENT_BYTES. The memory is freed with the last view
    of the array."""
    size = -(-count // HOST_ALIGNMENT_BYTES) * HOST_ALIGNMENT_BYTES
    if size < MIN_RECYCLED_BYTES:
        return _aligned(np.empty(size + HOST_ALIGNMENT_BYTES, np.uint8))[:count]
    raw = _found(size + HOST_ALIGNMENT_BYTES)
    return _aligned(np.asarray(_Block(np.empty(size + HOST_ALIGNMENT_BYTES, np.uint8) if raw is None else raw)))[:count]


def _found(size: int) -> NDArray[np.uint8] | None:
    # A finalizer may call this function while this thread holds the lock. Then the caller allocates new memory.
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
    """Owner of a block of host memory. NumPy keeps this object alive as long as an array in the block exists."""

    def __init__(self, raw: NDArray[np.uint8]) -> None:
        self._raw = raw
        self.__array_interface__: dict[str, Any] = raw.__array_interface__

    def __del__(self) -> None:
        # An array may be deleted while this thread holds the lock. Then the block is freed instead of kept for reuse.
        if not _lock.acquire(blocking=False):
            return
        try:
            _idle.append(self._raw)
            while sum(map(len, _idle)) > MAX_IDLE_BYTES:
                _idle.pop(0)
        finally:
            _lock.release()


def _aligned(memory: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return memory[-memory.ctypes.data % HOST_ALIGNMENT_BYTES :]
