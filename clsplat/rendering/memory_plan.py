# SPDX-License-Identifier: Apache-2.0
"""Device memory plan: the division into tile bands and streamed parts by which a frame or training step fits the limit.

Policy only: no OpenCL.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from math import ceil

from clsplat.chunks.division import listed_chunks
from clsplat.chunks.residency import CROSSING_SHARE
from clsplat.errors import CapacityError, amount
from clsplat.layouts.columns import CHUNK_ROWS


def mebibytes(nbytes: int) -> str:
    """A number of bytes as text, to a tenth of a MiB; below 10 MiB in a smaller unit."""
    return f"{nbytes / 2**20:,.1f} MiB" if nbytes >= 10 * 2**20 else amount(nbytes)


@dataclass(frozen=True)
class Need:
    """Device memory that a frame or a training step needs, in bytes unless noted.

    gaussians: number of Gaussians.
    model: bytes per Gaussian of its parameters, and in a training step of its moments.
    widest: bytes per Gaussian of the largest parameter array.
    row: bytes per Gaussian of all other arrays.
    banded: further bytes per Gaussian if the tiles are divided into bands.
    pair: bytes per (tile, Gaussian) pair.
    most_pairs: number of pairs at which the largest pair array reaches the limit of one allocation.
    planes: bytes of all arrays that are as large as the image.
    scratch: bytes of all other arrays.
    photographs: bytes of the photographs, which the device keeps between steps if it has room.
    statistics: bytes of `row` that are stored in a chunk's record, if Gaussians are streamed by chunk.
    held: bytes of `row` that every Gaussian needs, in view or not, in a step over the chunks in view; None if steps run
        over all chunks.
    pool: bytes for parameters, moments and statistics of the Gaussians on the device; None lets the plan choose.
    in_view: largest number of rows in the chunks that one view shows, as far as known; 0 unless steps run over the
        chunks in view.
    in_step: the same for all views of a step of several views.
    gradients: bytes per Gaussian of a view's gradients, and of their sums, in steps of several views over the chunks in
        view. Twice as many are in `model`.
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
    statistics: int = 0
    held: int | None = None
    pool: int | None = None
    in_view: int = 0
    in_step: int = 0
    gradients: int = 0

    @property
    def pairs(self) -> int:
        """Estimated number of (tile, Gaussian) pairs of a frame that shows all Gaussians."""
        return ESTIMATED_PAIRS_PER_GAUSSIAN * self.gaussians

    @property
    def total(self) -> int:
        """Bytes needed if everything except photographs is on the device at once."""
        return self.planes + self.scratch + self.gaussians * (self.row + self.model) + self.pairs * self.pair

    @property
    def record(self) -> int:
        """Bytes of a Gaussian in a chunk's record: parameters, moments and statistics."""
        return self.model - 2 * self.gradients + self.statistics

    @property
    def moving(self) -> int:
        """Bytes of a second copy of parameters and moments, which exists while density control moves rows."""
        return self.gaussians * self.model


ESTIMATED_PAIRS_PER_GAUSSIAN = 8
"""Estimated number of tiles that a Gaussian reaches. Trained scenes have 3 to 8."""
PAIRS_IN_VIEW = 4
"""Number of pairs per Gaussian on the device for which a plan by chunks leaves memory. It is less than
ESTIMATED_PAIRS_PER_GAUSSIAN, because not all Gaussians of a chunk are in view."""


@dataclass(frozen=True)
class Plan:
    """The division of a frame or training step, so that it fits the memory.

    rows: number of Gaussians whose parameters and moments are on the device at once.
    streamed: True if not all Gaussians stay on the device, so that parameters are streamed.
    pairs: largest number of (tile, Gaussian) pairs at once.
    gathers: True if the device moves rows for density control, False if the host does.
    allowed: memory limit, bytes.
    bands: estimated number of bands of tiles, which are listed and blended one after the other.
    photographs: bytes of photographs that stay on the device.
    """

    need: Need
    rows: int
    streamed: bool
    pairs: int
    gathers: bool
    allowed: int
    bands: int
    photographs: int = 0

    @property
    def pieces(self) -> tuple[bool, bool]:
        """Two flags: True if the parameters are streamed in parts, and True if the image is divided into bands."""
        return self.streamed, self.bands > 1

    @property
    def tight(self) -> bool:
        """True if memory is short, so that the work is divided, or the host moves the rows for density control."""
        return any(self.pieces) or not self.gathers

    def __str__(self) -> str:
        """The plan in a line of text, which training prints."""
        how = []
        if self.streamed:
            within = "" if self.need.pool is None else " within --max-host-mem"
            how.append(f"parameters are streamed, {self.rows:,} Gaussians at a time{within}")
        if self.bands > 1:
            how.append(f"the image is rendered in about {self.bands} bands of tiles")
        needed, allowed = mebibytes(self.need.total), mebibytes(self.allowed)
        return f"about {needed} of device memory needed, {allowed} allowed: " + (", ".join(how) or "all at once")


def plan(need: Need, budget: int, max_allocation: int, alignment: int) -> Plan:
    """Divide the work according to the estimated number of pairs.

    If not everything fits at once, the tiles are divided into bands. If there would be many bands, the parameters are
    also streamed in parts. Bands come first because they repeat little work, while parts cross the bus in every step.
    A frame with more pairs than `Plan.pairs` is divided by `stages.duplicate.plan_bands`.

    budget: memory limit, bytes.
    max_allocation: largest size of an array, bytes.
    alignment: `Plan.rows` must be a multiple of this if parameters are streamed.
    Raises CapacityError if not even the smallest pieces fit.
    """
    photographs = min(max(budget - need.total - need.moving, 0) // 2, need.photographs)
    room = budget - need.planes - need.scratch - need.gaussians * (need.row + need.banded) - photographs

    def made(rows: int, *, streamed: bool) -> Plan:
        pairs = min((room - rows * need.model) // need.pair, need.most_pairs)
        gathers = not streamed and need.total + need.moving + photographs <= budget
        bands = -(-need.pairs // max(pairs, 1)) if need.total > budget or need.pairs > need.most_pairs else 1
        return Plan(need, rows, streamed, pairs, gathers, budget, bands, photographs)

    whole = made(need.gaussians, streamed=False)
    enough = min(need.pairs // 8, need.gaussians) + 1
    if need.pool is None and need.gaussians * need.widest <= max_allocation and whole.pairs >= enough:
        return whole
    if need.held is not None:
        return plan_by_chunk(need, budget, max_allocation)
    for_rows = min(room // 4, room - need.gaussians * need.pair)  # one tile may list all Gaussians
    rows = max(min(for_rows // need.model, max_allocation // need.widest, need.gaussians), alignment)
    rows -= rows % alignment
    streamed = made(rows, streamed=True)
    if streamed.pairs < 1:
        least = budget - room + alignment * need.model + max(need.gaussians // 8, 1) * need.pair
        raise _too_little(need, least, budget)
    return streamed


def _too_little(need: Need, least: int, budget: int) -> CapacityError:
    in_view = min(max(need.in_view, need.in_step), need.gaussians)
    shown = f", with {in_view:,} of them in chunks that a step shows," if in_view else ""
    return CapacityError(
        f"{need.gaussians:,} Gaussians at this size of image{shown} need at least about {_rounded_up(least)} of device "
        f"memory, or {mebibytes(need.total)} to be processed at once, but {mebibytes(budget)} are allowed: allow more "
        "(--max-device-mem), or use a smaller resolution or fewer Gaussians"
    )


def _rounded_up(nbytes: int) -> str:
    """A number of bytes as text, like `mebibytes`, but rounded up, so that a memory limit of this size is enough."""
    unit = 2**20 / 10 if nbytes >= 10 * 2**20 else 2**10 if nbytes >= 10 * 2**10 else 1
    return mebibytes(ceil(ceil(nbytes / unit) * unit))


def plan_by_chunk(need: Need, budget: int, max_allocation: int) -> Plan:
    """Plan steps over the chunks in view. Raises CapacityError if not even one chunk fits.

    The arrays with a row for each Gaussian in view have memory for as many rows as the pool, or for `need.in_view` rows
    if these are more. In steps of several views, sums of gradients have at least `need.in_step` rows.

    budget, max_allocation: as for `plan`.
    """
    assert need.held is not None, "steps over the chunks in view"
    room = budget - need.planes - need.scratch - need.gaussians * need.held - CHUNK_ROWS * need.record
    by_slot = CHUNK_ROWS * (need.record + need.record // CROSSING_SHARE + need.gradients)
    by_row = need.row - need.statistics - need.held + need.banded

    def without_pairs(slots: int) -> int:
        """Bytes of a pool of `slots` slots and of the arrays with a row for each Gaussian in view, without pairs."""
        rows, sums = (max(CHUNK_ROWS * listed_chunks(slots), shown) for shown in (need.in_view, need.in_step))
        return slots * by_slot + rows * by_row + sums * need.gradients

    def wanted(slots: int) -> int:
        """Bytes of `without_pairs` and of arrays of pairs. There is at least one pair for each row in view, as one tile
        may list all rows."""
        return without_pairs(slots) + max(PAIRS_IN_VIEW * CHUNK_ROWS * slots, need.in_view) * need.pair

    most = min(max_allocation // need.widest, need.gaussians + CHUNK_ROWS - 1)
    if need.pool is not None:
        most = min(most, need.pool // need.record)
    most //= CHUNK_ROWS
    slots = bisect_right(range(1, most + 1), room, key=wanted)
    if slots == 0 and most > 0 and without_pairs(1) + PAIRS_IN_VIEW * CHUNK_ROWS * need.pair <= room:
        slots = 1  # memory for fewer pairs than `wanted` counts: few views have a tile that lists all rows
    if slots == 0:
        raise _too_little(need, budget - room + wanted(1), budget)
    pairs = min((room - without_pairs(slots)) // need.pair, need.most_pairs)
    return Plan(need, CHUNK_ROWS * slots, streamed=True, pairs=pairs, gathers=False, allowed=budget, bands=1)
