# SPDX-License-Identifier: Apache-2.0
"""The size that training works at, step by step."""

from __future__ import annotations

from clsplat.training.supervision.resolution import by_doubling


def test_doubling() -> None:
    sizes = by_doubling((250, 500))
    assert [sizes.factor(step) for step in (1, 250, 251, 500, 501, 7000)] == [4, 4, 2, 2, 1, 1]
    assert by_doubling(()).factor(1) == 1
