# SPDX-License-Identifier: Apache-2.0
"""The page of other programs' files has the tests' table."""

from __future__ import annotations

import other_programs
import pytest


def test_the_page_has_the_tests_marks() -> None:
    text = other_programs.PAGE.read_text("utf-8")
    assert other_programs.page(text) == text, "python3 tools/ci/other_programs.py writes it anew"
    assert len(other_programs.rows()) > 10


def test_another_table_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    changed = [*other_programs.rows()[1:], ("a", "b", "c", "d")]
    monkeypatch.setattr(other_programs, "rows", lambda: changed)
    text = other_programs.PAGE.read_text("utf-8")
    assert other_programs.page(text) != text
    assert "| a | b | c | d |" in other_programs.page(text)
