# SPDX-License-Identifier: Apache-2.0
"""Photographs in main memory, within a limit (--max-host-mem), and read ahead of the steps. Uses no OpenCL."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict, deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache, cached_property
from typing import Any

from numpy.typing import NDArray

from clsplat.errors import warn
from clsplat.training.supervision.decoding import Decoder

MAX_READING_THREADS = 8
"""Maximum number of threads that read photographs ahead."""
Key = tuple[int, float]
"""A view's index, and the divisor of its width and height."""


@cache  # counting processors takes longer than the rest of `read_ahead`
def reading_threads() -> int:
    """Number of threads that read photographs ahead, one for each photograph that is read ahead."""
    return min(2 * (os.cpu_count() or 1), MAX_READING_THREADS)


class HostPhotographs:
    """Decoded photographs in main memory, for several threads.

    Without a limit, every photograph that was used stays, also in the sizes that the training needs later. With a
    limit, only the current size is kept, of as many photographs as fit. The most recently used ones are evicted first,
    because no step of this epoch needs them again.

    at_once: number of views that a step uses.
    """

    def __init__(self, decoder: Decoder, at_once: int = 1) -> None:
        self.decoder, self._at_once = decoder, at_once
        self._lock = threading.Lock()
        self._held: OrderedDict[Key, NDArray[Any]] = OrderedDict()
        self._bytes = 0
        self._factor = self._complete = 0.0
        self._room: int | None = None
        self._ahead = reading_threads()
        self._wanted: set[Key] = set()
        self._in_use: deque[Key] = deque(maxlen=at_once + 1)
        self._pending: dict[Key, Future[dict[float, NDArray[Any]]]] = {}
        self._pool: ThreadPoolExecutor | None = None
        self._closed = False

    @property
    def bounded(self) -> bool:
        """True if there is a limit, so that photographs may be evicted."""
        return self._room is not None

    @cached_property
    def least(self) -> int:
        """Smallest possible limit in bytes: for the views of a step, one view that is read ahead, and decoding."""
        return self._needed(1)

    @cached_property
    def _sizes(self) -> tuple[int, int]:
        return self.decoder.largest(), self.decoder.working()

    def _needed(self, ahead: int) -> int:
        largest, working = self._sizes
        return ahead * (working + largest) + (self._at_once + 1 + ahead) * largest

    def follow(self, allowed: int) -> None:
        """Limit the photographs to `allowed` bytes, or to `least` if that is more."""
        allowed, largest, working = max(allowed, self.least), *self._sizes
        with self._lock:
            ahead = reading_threads()
            while ahead > 1 and self._needed(ahead) > allowed:
                ahead -= 1
            self._ahead, self._room = ahead, allowed - ahead * (working + largest)
            self._evict()

    def get(self, index: int, factor: float) -> NDArray[Any]:
        """Pixels (H, W, C) of view `index` at 1/factor of its size; do not write to them. Raises PhotographError."""
        key = index, factor
        with self._lock:
            self._enter(factor)
            self._in_use.append(key)
            image = self._held.get(key)
            if image is not None:
                self._held.move_to_end(key)
                return image
            future = self._pending.pop(key, None)
        # if no thread has begun to read the view, read it here
        made = future.result() if future is not None and not future.cancel() else self._made(key)
        self._tell()
        return made[factor]

    def replace(self, index: int, factor: float, image: NDArray[Any]) -> None:
        """Keep `image` as the pixels of view `index` at 1/factor of its size, instead of the file's, until it is
        evicted."""
        with self._lock:
            self._keep((index, factor), image)

    def has_all(self, factor: float) -> bool:
        """True if all photographs are in memory at 1/factor of their size, so that nothing has to be read ahead. With a
        limit it is always False."""
        if self._room is not None or factor == self._complete:
            return self._room is None
        with self._lock:
            if sum(size == factor for _, size in self._held) == len(self.decoder.views):
                self._complete = factor
        return factor == self._complete

    def read_ahead(self, keys: Sequence[Key]) -> None:
        """Begin to read the photographs of the next steps, in the order of their use. `get` raises their errors."""
        with self._lock:
            keys = keys[: self._ahead]
            self._wanted = set(keys)
            missing = [key for key in keys if key not in self._held and key not in self._pending]
            if not missing or self._closed:
                return
            if self._pool is None:
                self._pool = ThreadPoolExecutor(reading_threads(), "clsplat-photographs")
            under_way = sum(not future.done() for future in self._pending.values())
            for key in missing[: max(self._ahead - under_way, 0)]:
                self._pending[key] = self._pool.submit(self._made, key)

    def close(self) -> None:
        """End the threads that read ahead. `get` still works."""
        with self._lock:
            self._closed, pool, self._pool = True, self._pool, None
            self._pending.clear()
        if pool is not None:
            pool.shutdown(cancel_futures=True)
        self._tell()

    def _made(self, key: Key) -> dict[float, NDArray[Any]]:
        """Read a photograph from the disk cache, or decode it, and keep it. Returns the result of `Decoder.pixels`."""
        index, factor = key
        images = self.decoder.pixels(index, factor, keeps=not self.bounded)
        with self._lock:
            for each, image in images.items():
                # larger divisors belong to picture sizes that the training no longer uses
                if each <= self._factor or not self._factor:
                    self._keep((index, each), image)
            self._pending.pop(key, None)
        return images

    def _keep(self, key: Key, image: NDArray[Any]) -> None:
        before = self._held.pop(key, None)
        self._bytes += image.nbytes - (0 if before is None else before.nbytes)
        self._held[key] = image
        self._evict()

    def _evict(self) -> None:
        """Evict photographs beyond the limit, most recently used first, but none of the current or the next steps."""
        if self._room is None or self._bytes <= self._room:
            return
        for key in [key for key in reversed(self._held) if key not in self._wanted and key not in self._in_use]:
            if self._bytes <= self._room:
                return
            self._bytes -= self._held.pop(key).nbytes

    def _enter(self, factor: float) -> None:
        """When the size changes, evict photographs of earlier sizes. With a limit on memory, evict those of later sizes
        too, which were read ahead."""
        if factor == self._factor:
            return
        self._factor = factor
        for key in [key for key in self._held if key[1] > factor or (self.bounded and key[1] != factor)]:
            self._bytes -= self._held.pop(key).nbytes
        for key in [key for key in self._pending if key[1] > factor]:
            self._pending.pop(key).cancel()

    def _tell(self) -> None:
        """Warn of failures of the disk cache. The threads that read ahead only record them."""
        if self.decoder.store is not None:
            for text in self.decoder.store.notes():
                warn(text)
