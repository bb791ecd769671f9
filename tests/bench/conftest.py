# SPDX-License-Identifier: Apache-2.0
"""A fixture of the tests of the benchmark."""

from __future__ import annotations

import pytest
from benched import quick_limits

from clsplat.bench import stages as bench_stages


@pytest.fixture
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_stages, "measure_limits", quick_limits)
