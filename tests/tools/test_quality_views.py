# SPDX-License-Identifier: Apache-2.0
"""The settings of `tools/quality_views.py`, and those that the tables try."""

from __future__ import annotations

from dataclasses import replace

import pytest
import quality_table
import quality_views

from clsplat.config.presets import scheduled
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError
from clsplat.scenes.answers import answered
from clsplat.scenes.findings import Finding


def test_settings_of_a_row() -> None:
    short = scheduled("short", 2000)
    assert quality_views.with_settings(7000, "") == scheduled("paper", 7000)
    words = "schedule=short,iterations=2000,thinning=0.2,density.growth=budget,density.max-gaussians=100"
    tried = quality_views.with_settings(7000, words)
    assert tried == replace(short, thinning=0.2, density=replace(short.density, growth="budget", max_gaussians=100))
    with pytest.raises(InputError, match="schedule=none: expected one of paper, short, high-rates"):
        quality_views.with_settings(7000, "schedule=none")
    with pytest.raises(InputError, match="--thinning 2: expected"):
        quality_views.with_settings(7000, "thinning=2")


def test_the_table_tries_what_auto_takes() -> None:
    _, config = answered([Finding("few views", "few")], TrainConfig(iterations=7000))
    assert quality_views.with_settings(7000, quality_table.AUTO[1].removeprefix("auto:")) == config
