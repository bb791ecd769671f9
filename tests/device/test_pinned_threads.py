# SPDX-License-Identifier: Apache-2.0
"""PoCL's threads, each on a processor of its own."""

from __future__ import annotations

import os
import sys
from collections.abc import Set as AbstractSet

import pytest

from clsplat.device.drivers.quirks import pin_threads

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="PoCL pins threads on Linux alone")


def pinned(monkeypatch: pytest.MonkeyPatch, allowed: AbstractSet[int], **given: str) -> dict[str, str]:
    """The environment afterwards, where `allowed` of four processors may be used."""
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(allowed))
    environment = dict(given)
    pin_threads(environment)
    return environment


def test_threads_are_pinned_where_all_processors_may_be_used(monkeypatch: pytest.MonkeyPatch) -> None:
    assert pinned(monkeypatch, {0, 1, 2, 3}) == {"POCL_AFFINITY": "1"}


@pytest.mark.parametrize("allowed", [{0, 1}, {2, 3}, {0, 1, 2, 4}])
def test_not_where_a_thread_s_number_may_be_nobody_s_processor(
    monkeypatch: pytest.MonkeyPatch, allowed: set[int]
) -> None:
    assert pinned(monkeypatch, allowed) == {}


@pytest.mark.parametrize("name", ["POCL_CPU_MAX_CU_COUNT", "POCL_MAX_PTHREAD_COUNT", "POCL_MAX_COMPUTE_UNITS"])
def test_not_where_pocl_has_fewer_threads(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    assert pinned(monkeypatch, {0, 1, 2, 3}, **{name: "1"}) == {name: "1"}


@pytest.mark.parametrize("value", ["0", "1", ""])
def test_a_variable_that_is_set_is_left(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    assert pinned(monkeypatch, {0, 1, 2, 3}, POCL_AFFINITY=value) == {"POCL_AFFINITY": value}
