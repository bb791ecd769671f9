# SPDX-License-Identifier: Apache-2.0
"""The limit of device memory, and the pieces that work is cut into because of it. Policy only: no OpenCL."""

from __future__ import annotations

from dataclasses import dataclass

from clsplat.errors import CapacityError, amount


def mebibytes(nbytes: int) -> str:
    """So many bytes for a line of text, to a tenth of a MiB; fewer than 10 MiB in a unit that tells them apart."""
    return f"{nbytes / 2**20:,.1f} MiB" if nbytes >= 10 * 2**20 else amount(nbytes)


@dataclass(frozen=True)
class Need:
    """Device memory that a frame, or a training step, needs, in bytes unless said otherwise.

    gaussians: their number; model: each one's parameters, in a step with moments; widest: each one's part
    of the widest of these arrays; row: of each, all the rest; banded: of each, what several bands of tiles add; pair:
    of each pair; most_pairs: their number at which the widest of their arrays is full; planes: all that is as large as
    the image; scratch: whatever is left over; photographs: those that the device may keep from step to step, as far as
    there is room.
    """

    gaussians: int
    model: int
    widest: int
    row: int
    banded: int
    pair: int
    most_pairs: int
    planes: int
    scratch: int
    photographs: int = 0

    @property
    def pairs(self) -> int:
        """A guess, before the first frame: how many there will be."""
        return PAIRS_EACH * self.gaussians

    @property
    def total(self) -> int:
        """Bytes with everything on the device at once, but for photographs."""
        return self.planes + self.scratch + self.gaussians * (self.row + self.model) + self.pairs * self.pair

    @property
    def moving(self) -> int:
        """Bytes of a second copy of parameters and moments, while rows move."""
        return self.gaussians * self.model


PAIRS_EACH = 8
"""Tiles that a Gaussian reaches, as a guess. Trained scenes have 3 to 8."""


@dataclass(frozen=True)
class Plan:
    """Division of the work, so that it fits the memory.

    rows: Gaussians whose parameters and moments are on the device at once; streamed: not all of them; pairs: most
    (tile, Gaussian) pairs at once; gathers: rows move on the device; allowed: bytes; groups: of tiles, estimated;
    photographs: bytes of those that stay on the device.
    """

    need: Need
    rows: int
    streamed: bool
    pairs: int
    gathers: bool
    allowed: int
    groups: int
    photographs: int = 0

    @property
    def pieces(self) -> tuple[bool, bool]:
        """True for each that is done in pieces: parameters, image."""
        return self.streamed, self.groups > 1

    @property
    def tight(self) -> bool:
        """True if there is no room to spare."""
        return any(self.pieces) or not self.gathers

    def __str__(self) -> str:
        """The line that training prints."""
        how = []
        if self.streamed:
            how.append(f"parameters are streamed, {self.rows:,} Gaussians at a time")
        if self.groups > 1:
            how.append(f"the image is done in about {self.groups} groups of tiles")
        needed, allowed = mebibytes(self.need.total), mebibytes(self.allowed)
        return f"about {needed} of device memory needed, {allowed} allowed: " + (", ".join(how) or "all at once")


def plan(need: Need, budget: int, max_allocation: int, alignment: int) -> Plan:
    """All at once if the guess of the pairs says so; else the tiles in bands, and when those would be many, the
    parameters in parts: bands repeat little, parts go over the bus in every step.

    alignment: what the number of rows is a multiple of. Raises CapacityError where not even the smallest pieces fit.
    """
    photographs = min(max(budget - need.total - need.moving, 0) // 2, need.photographs)
    room = budget - need.planes - need.scratch - need.gaussians * (need.row + need.banded) - photographs

    def made(rows: int, *, streamed: bool) -> Plan:
        pairs = min((room - rows * need.model) // need.pair, need.most_pairs)
        gathers = not streamed and need.total + need.moving + photographs <= budget
        groups = -(-need.pairs // max(pairs, 1)) if need.total > budget or need.pairs > need.most_pairs else 1
        return Plan(need, rows, streamed, pairs, gathers, budget, groups, photographs)

    whole = made(need.gaussians, streamed=False)
    enough = min(need.pairs // 8, need.gaussians) + 1
    if need.gaussians * need.widest <= max_allocation and whole.pairs >= enough:
        return whole
    for_rows = min(room // 4, room - need.gaussians * need.pair)  # a tile may have all Gaussians
    rows = max(min(for_rows // need.model, max_allocation // need.widest, need.gaussians), alignment)
    rows -= rows % alignment
    streamed = made(rows, streamed=True)
    if streamed.pairs < 1:
        least = budget - room + alignment * need.model + max(need.gaussians // 8, 1) * need.pair
        raise CapacityError(
            f"{need.gaussians:,} Gaussians at this size of image need at least about {mebibytes(least)} of device "
            f"memory, {mebibytes(need.total)} to be done at once, and {mebibytes(budget)} are allowed"
        )
    return streamed
