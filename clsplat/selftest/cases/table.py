# SPDX-License-Identifier: Apache-2.0
"""Tables of all cases (CASES) and of all stages of the self-test (OUTCOMES_BY_STAGE), by name."""

from __future__ import annotations

from collections.abc import Callable

from clsplat.selftest.case import Case
from clsplat.selftest.cases.appearance import COLOUR_CASES
from clsplat.selftest.cases.chunks import BOUNDS_CASE, CATCH_UP_CASE, CHUNK_RECORDS_CASE, CHUNKS_CASE
from clsplat.selftest.cases.core import CORE_STAGES
from clsplat.selftest.cases.density import MARKS_CASE, STATISTICS_CASE, of_statistics
from clsplat.selftest.cases.grid import GRID_CASE
from clsplat.selftest.cases.library import HARMONICS_CASE, SPLATS_CASE, of_ewa, of_values
from clsplat.selftest.cases.loss import DEPTH_LOSS_CASE, LOSS_CASE, MASKS_CASE, of_depth
from clsplat.selftest.cases.pictures import DEEP_MERGE_CASE, PICTURE_CASES
from clsplat.selftest.cases.poses import POSE_CASE, of_lens
from clsplat.selftest.cases.primitives import (
    APPEND_CASE,
    BITONIC_CASE,
    ELEMENTARY_CASE,
    LIST_COUNTS_CASE,
    SCAN_CASE,
    SORT_CASE,
    of_append,
)
from clsplat.selftest.cases.region import REGION_CASE
from clsplat.selftest.cases.steps import ADAM_CASE, NOISE_CASE, PENALTIES_CASE, SETTLE_CASE
from clsplat.selftest.harness import CaseBench, StageOutcome

CASES: dict[str, Case] = {
    "elementary": ELEMENTARY_CASE,
    "sort": SORT_CASE,
    "bitonic sort": BITONIC_CASE,
    "scan": SCAN_CASE,
    "list_counts": LIST_COUNTS_CASE,
    "append": APPEND_CASE,
    "loss": LOSS_CASE,
    "masks": MASKS_CASE,
    "depth loss": DEPTH_LOSS_CASE,
    "penalties": PENALTIES_CASE,
    "adam": ADAM_CASE,
    "settle": SETTLE_CASE,
    "bounds": BOUNDS_CASE,
    "chunks": CHUNKS_CASE,
    "catch_up": CATCH_UP_CASE,
    "chunk_records": CHUNK_RECORDS_CASE,
    "noise": NOISE_CASE,
    "region": REGION_CASE,
    **COLOUR_CASES,
    "grid": GRID_CASE,
    "pose": POSE_CASE,
    "harmonics": HARMONICS_CASE,
    "splats": SPLATS_CASE,
    "deep_merge": DEEP_MERGE_CASE,
    "statistics": STATISTICS_CASE,
    "marks": MARKS_CASE,
}
"""Cases by name. A case with inputs from a frozen scene (`Case.frozen`) is a stage of the self-test."""

OUTCOMES_BY_STAGE: dict[str, Callable[[CaseBench], StageOutcome]] = {
    **{name: case.outcome for name, case in CASES.items() if case.frozen is not None},
    **CORE_STAGES,
    "append": of_append,
    "statistics": of_statistics,
    **PICTURE_CASES,
    "depth": of_depth,
    "lens": of_lens,
    "ewa": of_ewa,
    "values": of_values,
}
