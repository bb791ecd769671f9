# SPDX-License-Identifier: Apache-2.0
"""Models that change over time: interpolation between samples, from a file per frame or a USD stage's time samples."""

from __future__ import annotations

import threading
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from clsplat.arrays import Float32, Float64
from clsplat.errors import InputError, warn
from clsplat.gaussians import Gaussians
from clsplat.models.edit import take

CACHED_SAMPLES_SINGLE, CACHED_SAMPLES_PAIR = 2, 3
"""Number of samples kept in memory after a request for one sample, or for two neighbours. One of them is the next
sample, which is read ahead."""
MAX_TRACKED_CHANGE_RATIO = 0.25
"""Largest ratio at which rows count as tracked, that is, as the same Gaussian in two samples. The ratio is the median
change of a row between the samples over the median difference of two rows.

Means, scales and colours are tested separately. The ratio is a few hundredths in tracked models, and about 1 in models
trained separately. The ratio of scales is about 1 even if such models are sorted by position.
"""
TRACKING_TEST_ROWS = 10_000
"""Number of evenly spaced rows that `follows` compares."""


class ModelSeries:
    """A model that changes over time, given by samples at some frames. Thread-safe.

    Between two samples Gaussians are interpolated, means linearly, if each row is the same Gaussian in both; otherwise
    the nearer sample is used. Before the first sample the first is used, after the last sample the last. Unless
    `held` is set, the means of that sample continue their motion. They move as far in a time t before the first
    sample as in the time t after it. After the last sample the same holds, in reverse.
    """

    def __init__(
        self, frames: Sequence[float], read: Callable[[int], Gaussians], where: str, *, held: bool = False
    ) -> None:
        """Read the first sample.

        frames: frames of the samples, in increasing order.
        read: function that reads the sample at an index; raises InputError.
        where: prefix of messages.
        held: True to keep the means fixed before the first sample and after the last; else their motion continues.
        """
        self.frames, self.where, self.held = tuple(frames), where, held
        self._read = read
        self._lock = threading.RLock()
        self._ahead = ThreadPoolExecutor(1, "clsplat-models")
        self._known: OrderedDict[int, Future[Gaussians]] = OrderedDict()
        self._follow: dict[int, bool] = {}
        self._wanted: list[int] = []
        self._told = False
        first = read(0)
        self.count = len(first)
        """Number of Gaussians in the first sample."""
        self.kind = take(first, slice(0))
        """Empty model with `antialiased` and `by_rays` of all samples, and the near plane of the first."""
        self._known[0] = Future()
        self._known[0].set_result(first)

    def at(self, frame: float) -> Gaussians:
        """Gaussians at a frame.

        Raises InputError if a sample cannot be read, or if its `antialiased` or `by_rays` differs from the first's.
        """
        with self._lock:
            inside = min(max(frame, self.frames[0]), self.frames[-1])
            if inside != frame and not self.held:
                return self._beyond(frame, inside)
            index, share = self._place(frame)
            if share == 0:
                return self._sample(index, CACHED_SAMPLES_SINGLE)
            if not self._follows(index):
                return self._sample(index + round(share))
            return between(self._sample(index), self._sample(index + 1), share)

    def moved(self, start: float, end: float) -> Gaussians:
        """Gaussians at the frame `start`, but with their means at the frame `end`.

        If Gaussians do not keep their rows between the two frames, means do not change, and a warning says so.
        """
        with self._lock:
            there = self.at(start)
            if not all(map(self._follows, self._sections(start, end))):
                self._warn_of_no_motion()
                return there
            return replace(there, means=_means_from(self.at(end), there))

    def sources(self, frame: float) -> tuple[int, ...]:
        """Indices of the samples that a frame depends on. Reads no sample."""
        return tuple(sorted({at for section in self._sections(frame, frame) for at in (section, section + 1)})) or (
            self._place(frame)[0],
        )

    def _sections(self, start: float, end: float) -> range:
        """Indices of the intervals that two frames and the motion between them depend on.

        Interval i lies between the samples i and i + 1.
        """
        (first, _), (last, share) = (self._place(frame) for frame in sorted((start, end)))
        low, high = first, last + (share > 0)
        if not self.held and len(self.frames) > 1:
            low = min(low, len(self.frames) - 2) if max(start, end) > self.frames[-1] else low
            high = max(high, 1) if min(start, end) < self.frames[0] else high
        return range(low, high)

    def _place(self, frame: float) -> tuple[int, float]:
        """Index of the last sample at or before a frame, and the fraction of the way to the next sample."""
        frame = min(max(frame, self.frames[0]), self.frames[-1])
        index = bisect_right(self.frames, frame) - 1
        if index + 1 == len(self.frames):
            return index, 0.0
        before, after = self.frames[index], self.frames[index + 1]
        return index, (frame - before) / (after - before)

    def _beyond(self, frame: float, end: float) -> Gaussians:
        now, before = self.at(end), self.at(min(max(2 * end - frame, self.frames[0]), self.frames[-1]))
        if not all(map(self._follows, self._sections(frame, frame))):
            return now
        return replace(now, means=(2 * now.means - _means_from(before, now)).astype(np.float32))

    def expect(self, frames: Sequence[float]) -> None:
        """Announce frames that will be requested later, so that their samples are read ahead."""
        wanted = {index for frame in frames for index in self.sources(frame)}
        self._wanted = sorted({*self._wanted, *wanted})

    def _sample(self, index: int, most: int = CACHED_SAMPLES_PAIR) -> Gaussians:
        """Return a sample from memory or its file, and start to read the next announced sample.

        most: number of samples to keep in memory. The least recently requested samples are dropped.
        """
        future = self._future(index)
        self._known.move_to_end(index)
        later = self._wanted[bisect_right(self._wanted, index) :][:1]
        oldest = [other for other in self._known if other not in (index, *later)]
        for other in oldest[: max(len({*self._known, *later}) - most, 0)]:  # frees memory for the next sample
            del self._known[other]
        for other in later:
            self._future(other)
        return future.result()

    def _future(self, index: int) -> Future[Gaussians]:
        if index not in self._known:
            self._known[index] = self._ahead.submit(self._checked, index)
        return self._known[index]

    def _checked(self, index: int) -> Gaussians:
        sample = self._read(index)
        if index == 0:
            return sample
        for what in ("antialiased", "by_rays"):
            if getattr(sample, what) != getattr(self.kind, what):
                raise InputError(
                    f"{self.where}: frame {self.frames[index]:g} is {_alike(sample, what)}, frame {self.frames[0]:g} "
                    f"is {_alike(self.kind, what)}, expected models that are drawn alike"
                )
        # all samples get the near plane of the first
        return sample if sample.near == self.kind.near else replace(sample, near=self.kind.near)

    def _follows(self, index: int) -> bool:
        """True if Gaussians keep their rows from the sample `index` to the next one."""
        if index not in self._follow:
            self._follow[index] = follows(self._sample(index), self._sample(index + 1))
        return self._follow[index]

    def _warn_of_no_motion(self) -> None:
        if not self._told:
            self._told = True
            warn(
                f"{self.where}: Gaussians do not keep their order from frame to frame, so motion channels show "
                "only the camera's motion"
            )


def _alike(model: Gaussians, what: str) -> str:
    words = "drawn along rays" if what == "by_rays" else what
    return words if getattr(model, what) else f"not {words}"


def follows(before: Gaussians, after: Gaussians) -> bool:
    """True if each row seems to be the same Gaussian in both models (MAX_TRACKED_CHANGE_RATIO)."""
    if len(before) != len(after) or before.sh.shape != after.sh.shape:
        return False
    step = max(len(before) // TRACKING_TEST_ROWS, 1)
    pairs = (
        (before.means, _means_from(after, before)),
        (before.log_scales, after.log_scales),
        (before.sh[:, 0], after.sh[:, 0]),
    )
    for own, other in pairs:
        ours, theirs = own[::step].astype(np.float64), other[::step].astype(np.float64)
        change = np.median(np.linalg.norm(theirs - ours, axis=1))
        apart = np.median(np.linalg.norm(np.roll(ours, max(len(ours) // 2, 1), axis=0) - ours, axis=1))
        if change > MAX_TRACKED_CHANGE_RATIO * apart and len(ours) > 1:
            return False
    return True


def between(before: Gaussians, after: Gaussians, share: float) -> Gaussians:
    """Interpolate two models: rotations by nlerp along the shorter arc, everything else linearly.

    share: fraction of the way from `before` to `after`.
    """

    def line(ours: Float32, theirs: Float32) -> Float32:
        return ((1 - share) * ours.astype(np.float64) + share * theirs).astype(np.float32)

    q, r = (_normalised(model.quaternions.astype(np.float64)) for model in (before, after))
    r = np.where((q * r).sum(axis=1, keepdims=True) < 0, -r, r)
    return replace(
        before,
        means=line(before.means, _means_from(after, before)),
        quaternions=_normalised((1 - share) * q + share * r).astype(np.float32),
        log_scales=line(before.log_scales, after.log_scales),
        opacity_logits=line(before.opacity_logits, after.opacity_logits),
        sh=line(before.sh, after.sh),
    )


def _normalised(quaternions: Float64) -> Float64:
    lengths = np.linalg.norm(quaternions, axis=1, keepdims=True)
    return np.asarray(np.divide(quaternions, lengths, out=np.zeros_like(quaternions), where=lengths > 0))


def _means_from(model: Gaussians, other: Gaussians) -> Float32:
    """Means (n, 3) of `model`, relative to the origin of the model `other`."""
    shift = model.origin - other.origin
    return (model.means + shift).astype(np.float32) if shift.any() else model.means
