# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/quality.md: finished rows are kept, others go on; half of the better one's Gaussians."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import quality_table
from quality_table import Book, Row


class FakeClsplat:
    """The command, which writes what a training would; the first `ends` calls of `train` are interrupted."""

    def __init__(self, ends: int = 0) -> None:
        self.calls: list[tuple[str, ...]] = []
        self.ends = ends

    def __call__(self, *arguments: str) -> str:
        self.calls.append(arguments)
        if arguments[0] == "eval":
            return json.dumps({"mean": {"psnr": 20.0 + int(arguments[3])}})
        run = Path(arguments[3])
        run.mkdir(parents=True, exist_ok=True)
        (run / "config.toml").write_text("")
        if self.ends:
            self.ends -= 1
            raise SystemExit("interrupted")
        psnr = 31.0 if "short" in run.name else 30.0
        told = {"mean": {"psnr": psnr, "ssim": 0.9}, "gaussians": 1000 if "short" in run.name else 500, "seconds": 7.0}
        (run / "eval.json").write_text(json.dumps(told))
        return ""


ENDS = [Row("fox default", "fox"), Row("fox short", "fox", ("--schedule", "short"))]
HALF = Row("fox mcmc", "fox", half_of=("fox default", "fox short"))


def test_a_finished_row_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeClsplat()
    monkeypatch.setattr(quality_table, "_clsplat", fake)
    for _ in range(2):
        Book(tmp_path, tmp_path / "work", 2, 40, 0).results("growth", ENDS[0], ENDS)
        assert [call[0] for call in fake.calls] == ["train", "train"]


def test_an_interrupted_row_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeClsplat(ends=1)
    monkeypatch.setattr(quality_table, "_clsplat", fake)
    book = Book(tmp_path, tmp_path / "work", 1, 40, 0)
    with pytest.raises(SystemExit):
        book.results("growth", ENDS[0], ENDS)
    book.results("growth", ENDS[0], ENDS)
    assert ["--resume" in call for call in fake.calls] == [False, True]


def test_half_of_the_better_ones_gaussians(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeClsplat()
    monkeypatch.setattr(quality_table, "_clsplat", fake)
    Book(tmp_path, tmp_path / "work", 1, 40, 0).results("growth", HALF, [*ENDS, HALF])
    last = fake.calls[-1]
    assert last[last.index("--density.max-gaussians") + 1] == "500"


def test_sizes_are_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quality_table, "_clsplat", FakeClsplat())
    row = Row("lego", "lego", sizes=(4, 2))
    found = Book(tmp_path, tmp_path / "work", 1, 40, 0).results("antialiasing", row, [row])
    assert quality_table.line(row, found) == "| lego | 30.00 | 0.00 | 0.9000 | 500 | 7 | 24.00 | 22.00 | 23.00 |"
    assert quality_table.header([row]).splitlines()[0].endswith("| seconds | 4 | 2 | mean |")


def test_a_table_that_is_not_known(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert quality_table.main([str(tmp_path), "-o", str(tmp_path), "--only", "grwth"]) == 2
    assert "--only grwth: no such table, expected some of growth" in capsys.readouterr().err


def test_a_scene_that_is_missing_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert quality_table.main([str(tmp_path), "-o", str(tmp_path / "work"), "--only", "antialiasing", "--list"]) == 0
    assert "lego is left out: no " in capsys.readouterr().err


def test_only_the_rows_that_are_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(quality_table, "_clsplat", FakeClsplat())
    for scene in quality_table.SCENES:
        (tmp_path / scene).mkdir()
    where = [str(tmp_path), "-o", str(tmp_path / "work"), "--only", "growth", "--seeds", "1"]
    assert quality_table.main([*where, "--rows", "fox mcmc,bonsai mcmc ???k"]) == 0
    rows = [line.split(" | ")[0] for line in capsys.readouterr().out.splitlines()[4:] if line]
    assert rows == ["| fox mcmc", "| bonsai mcmc 290k"]
    trained = {path.stem for path in (tmp_path / "work").rglob("*.json") if path.parent.name == "growth"}
    assert trained == {"fox-default-0", "fox-short-0", "fox-mcmc-0", "bonsai-mcmc-290k-0"}  # and what they are half of
    assert quality_table.main([*where, "--rows", "fax *"]) == 2
    assert capsys.readouterr().err.endswith("--rows fax *: no such row; --list prints them\n")
