# SPDX-License-Identifier: Apache-2.0
"""A model that changes: Gaussians at some frames, as a file a frame or a stage's time samples hold them, and what they
are between these."""

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

ALONE, PAIR = 2, 3
"""Samples that are held once one was asked for, or two that follow each other: with the one that is read ahead."""
LIKE = 0.25
"""Gaussians keep their numbers from one sample to the next if the median change of a row is at most this part of the
median difference of two rows: of means, scales and colours each. What is tracked is at a few hundredths, models that
were trained apart at about 1, in scales also where their Gaussians are sorted by place."""
COMPARED = 10_000
"""Rows of which that is asked, spread evenly."""


class Series:
    """Gaussians that change over time. May be asked from several threads.

    At a sample's frame they are its own. Between two they are interpolated where Gaussians keep their numbers, means
    in straight lines, else they are those of the nearer sample. Beyond the ends they are the end's; where they are not
    `held`, means go on as they did, mirrored.
    """

    def __init__(
        self, frames: Sequence[float], read: Callable[[int], Gaussians], where: str, *, held: bool = False
    ) -> None:
        """frames: of the samples, rising; read: the sample of an index, raises InputError; where: begins messages."""
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
        """Gaussians of the first sample."""
        self.kind = take(first, slice(0))
        """A model of no Gaussians that is drawn as all samples are."""
        self._known[0] = Future()
        self._known[0].set_result(first)

    def at(self, frame: float) -> Gaussians:
        """The Gaussians at a frame. Raises InputError for a sample that cannot be read, or is drawn otherwise than the
        first."""
        with self._lock:
            inside = min(max(frame, self.frames[0]), self.frames[-1])
            if inside != frame and not self.held:
                return self._beyond(frame, inside)
            index, share = self._place(frame)
            if share == 0:
                return self._sample(index, ALONE)
            if not self._follows(index):
                return self._sample(index + round(share))
            return between(self._sample(index), self._sample(index + 1), share)

    def moved(self, start: float, end: float) -> Gaussians:
        """The Gaussians at `start` with the means that they have at `end`: their own where Gaussians do not keep their
        numbers from one to the other, which a warning says."""
        with self._lock:
            there = self.at(start)
            if not all(map(self._follows, self._sections(start, end))):
                self._tell_of_no_motion()
                return there
            return replace(there, means=_means_from(self.at(end), there))

    def sources(self, frame: float) -> tuple[int, ...]:
        """Indices of the samples that the Gaussians at a frame are made of, without reading any."""
        return tuple(sorted({at for section in self._sections(frame, frame) for at in (section, section + 1)})) or (
            self._place(frame)[0],
        )

    def _sections(self, start: float, end: float) -> range:
        """The indices of the samples from each of which it is a part of the way to the next that the Gaussians of these
        frames are made of."""
        (first, _), (last, share) = (self._place(frame) for frame in sorted((start, end)))
        low, high = first, last + (share > 0)
        if not self.held and len(self.frames) > 1:
            low = min(low, len(self.frames) - 2) if max(start, end) > self.frames[-1] else low
            high = max(high, 1) if min(start, end) < self.frames[0] else high
        return range(low, high)

    def _place(self, frame: float) -> tuple[int, float]:
        """The last sample at or before a frame, the ends beyond them, and the share of the way to the next."""
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
        """Say which frames will be asked for, so that the next of their samples is read ahead."""
        wanted = {index for frame in frames for index in self.sources(frame)}
        self._wanted = sorted({*self._wanted, *wanted})

    def _sample(self, index: int, most: int = PAIR) -> Gaussians:
        """The sample, of those that are held or from its file; the next that is expected begins to be read. most: that
        are held then, those that were not asked for the longest go."""
        future = self._future(index)
        self._known.move_to_end(index)
        later = self._wanted[bisect_right(self._wanted, index) :][:1]
        oldest = [other for other in self._known if other not in (index, *later)]
        for other in oldest[
            : max(len({*self._known, *later}) - most, 0)
        ]:  # its memory is free before the next takes some
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
        # cameras see from one near plane on in all frames
        return sample if sample.near == self.kind.near else replace(sample, near=self.kind.near)

    def _follows(self, index: int) -> bool:
        """True if Gaussians keep their numbers from a sample to the next."""
        if index not in self._follow:
            self._follow[index] = follows(self._sample(index), self._sample(index + 1))
        return self._follow[index]

    def _tell_of_no_motion(self) -> None:
        if not self._told:
            self._told = True
            warn(
                f"{self.where}: Gaussians do not keep their numbers from frame to frame, so that motion channels have "
                "the camera's motion alone"
            )


def _alike(model: Gaussians, what: str) -> str:
    words = "drawn along rays" if what == "by_rays" else what
    return words if getattr(model, what) else f"not {words}"


def follows(before: Gaussians, after: Gaussians) -> bool:
    """True if each row is the same Gaussian in both models."""
    if len(before) != len(after) or before.sh.shape != after.sh.shape:
        return False
    step = max(len(before) // COMPARED, 1)
    pairs = (
        (before.means, _means_from(after, before)),
        (before.log_scales, after.log_scales),
        (before.sh[:, 0], after.sh[:, 0]),
    )
    for own, other in pairs:
        ours, theirs = own[::step].astype(np.float64), other[::step].astype(np.float64)
        change = np.median(np.linalg.norm(theirs - ours, axis=1))
        apart = np.median(np.linalg.norm(np.roll(ours, max(len(ours) // 2, 1), axis=0) - ours, axis=1))
        if change > LIKE * apart and len(ours) > 1:
            return False
    return True


def between(before: Gaussians, after: Gaussians, share: float) -> Gaussians:
    """The model that share of the way from one to the other: means, logarithms of scales, logits and SH in straight
    lines, rotations by normalised linear interpolation of their quaternions, the shorter way."""

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
    """The means of a model, counted from the origin of another."""
    shift = model.origin - other.origin
    return (model.means + shift).astype(np.float32) if shift.any() else model.means
