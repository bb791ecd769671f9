# SPDX-License-Identifier: Apache-2.0
"""The report at the end of a training."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

from clsplat.report import NAME
from clsplat.report.page import write_report

if TYPE_CHECKING:
    from clsplat.gaussians import Gaussians
    from clsplat.runs.run import Run
    from clsplat.scenes.scene import Scene


def write_last(run: Run, scene: Scene, model: Gaussians) -> None:
    """Write the report of a training that is done; trouble is a warning, as the model is there."""
    try:
        write_report(run, scene=scene, model=model)
    except Exception as error:  # noqa: BLE001  # hours of training must not end as a failure for the sake of a page
        why = " ".join(str(error).split()) or type(error).__name__
        warnings.warn(f"no {NAME} ({why}); try again with: clsplat report {run.path}", stacklevel=2)
