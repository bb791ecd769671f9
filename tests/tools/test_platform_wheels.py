# SPDX-License-Identifier: Apache-2.0
"""`platform_wheels.py`: what it asks for. The index itself is asked by hand and by the workflow of a release."""

from __future__ import annotations

from pathlib import Path

import platform_wheels
import pytest

ROOT = Path(__file__).resolve().parents[2]


def test_it_asks_for_the_systems_that_the_page_on_installing_has_wheels_for() -> None:
    page = (ROOT / "docs/install.md").read_text("utf-8")
    rows = [line.split(" | ")[0].removeprefix("| ") for line in page.splitlines() if "| all as wheels |" in line]
    assert [row.replace(" or later", "") for row in rows] == list(platform_wheels.SYSTEM_TAGS)
    assert platform_wheels.pythons() == ["3.10", "3.11", "3.12", "3.13", "3.14"]


def test_a_package_without_a_wheel_fails(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(platform_wheels, "resolved", lambda *_: (["a==1", "b==2"], ""))
    reasons = iter(["", "ERROR: No matching distribution found for b==2"])
    monkeypatch.setattr(platform_wheels, "pip_finds", lambda *_: next(reasons))
    arguments = ["--system", "Windows, x86-64", "--python", "3.12", "--python", "3.13"]
    assert platform_wheels.main(arguments) == 1
    assert capsys.readouterr().out.splitlines() == [
        "Windows, x86-64, Python 3.12: 2 packages, all as wheels",
        "Windows, x86-64, Python 3.13: ERROR: No matching distribution found for b==2",
    ]


def test_an_unknown_extra_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        platform_wheels.main(["--extra", "videos"])
    assert ended.value.code == 2 and "--extra videos: not an extra of pyproject.toml" in capsys.readouterr().err
