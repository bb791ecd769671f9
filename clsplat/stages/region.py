# SPDX-License-Identifier: Apache-2.0
"""The region in which a training changes Gaussians: defines and arguments of kernels (kernels/shared/region.h), and the
rows inside it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsplat.optimisation.trained_region import TrainedRegion
from clsplat.stages.device_gaussians import AnyArray

TESTED_ROWS = 1 << 20
"""Number of means that `rows_inside` copies to the host at a time."""


def region_build(region: TrainedRegion | None) -> tuple[dict[str, object], tuple[float, ...]]:
    """Return the defines and the further arguments of a kernel; both are empty if all Gaussians are trained.

    region: in the coordinates of the model's means.
    """
    return ({}, ()) if region is None else ({"REGION": True}, region.numbers)


def rows_inside(means: AnyArray, region: TrainedRegion) -> NDArray[np.uint32]:
    """Return the rows whose means (n, 3) are inside the region, in rising order.

    region: in the coordinates of the means.
    """
    count = means.shape[0]
    found = [
        begin + np.flatnonzero(region.contains(means.get_rows(begin, min(begin + TESTED_ROWS, count))))
        for begin in range(0, count, TESTED_ROWS)
    ]
    return np.concatenate(found).astype(np.uint32) if found else np.zeros(0, np.uint32)
