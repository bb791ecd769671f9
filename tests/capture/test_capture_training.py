# SPDX-License-Identifier: Apache-2.0
"""Settings of a capture's training: what the findings about the photographs ask for, and the schedule."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from calls import Capture

from clsplat.capture import training
from clsplat.config.presets import scheduled
from clsplat.config.training import TrainConfig
from clsplat.progress import no_progress
from clsplat.scenes.analysis.photo_findings import Finding

FEW_STEPS = Finding("few steps", "few steps a photograph")
EXPOSURE = Finding("exposure", "exposures differ")
SCENE: Any = SimpleNamespace(train_views=[None] * 40, views=[None] * 46, sampled_views=[None] * 46)


@pytest.mark.parametrize(
    ("found", "iterations", "schedule", "appearance"),
    [
        ([], 7000, "short", "none"),
        ([FEW_STEPS], 2000, "high-rates", "none"),
        ([EXPOSURE], 7000, "short", "exposure"),
        ([EXPOSURE, FEW_STEPS], 2000, "high-rates", "exposure"),
        ([], 10_000, "short", "none"),
        ([EXPOSURE], 10_001, "paper", "exposure"),
    ],
)
def test_the_schedule_follows_steps_and_photographs(
    found: list[Finding],
    iterations: int,
    schedule: Any,
    appearance: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: Capture,
) -> None:
    monkeypatch.setattr(training, "findings", lambda *_: found)
    config = TrainConfig(iterations=iterations)
    progress: Any = no_progress
    scene, better = training._adapted(SCENE, SCENE, config, progress, {"iterations"})
    assert scene is SCENE
    assert better.changed("appearance", "none") == scheduled(schedule, iterations)
    assert better.appearance == appearance
    told = capsys.readouterr().err
    assert told.startswith("inspected 46 photographs: ")
    assert all(finding.text in told for finding in found)
