# SPDX-License-Identifier: Apache-2.0
"""The tools that measure: what they print, and that wrong results and wrong calls are told."""

from __future__ import annotations

import json
from pathlib import Path

import bench_sort
import numpy as np
import pytest
from measuring import sizes

Capture = pytest.CaptureFixture[str]


def one_error(capsys: Capture, tool: str) -> str:
    captured = capsys.readouterr()
    last = captured.err.splitlines()[-1]
    assert captured.out == ""
    assert last.startswith(f"{tool}: error: ")
    return last


def test_sizes() -> None:
    assert sizes(10_000, 300_000) == [10_000, 30_000, 100_000, 300_000]
    assert sizes(10_000, 29_999) == [10_000]


def test_sort(tmp_path: Path, capsys: Capture) -> None:
    pytest.importorskip("matplotlib")
    plot = tmp_path / "sort.svg"
    assert bench_sort.main(["--max", "3e4", "--repeat", "1", "--json", "--plot", str(plot)]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [(row["sort"], row["n"]) for row in result["rows"]] == [
        (name, n) for n in (10_000, 30_000) for name in ("keys", "pairs")
    ]
    for row in result["rows"]:
        assert row["ns_per_key"] == pytest.approx(1e6 * row["ms"] / row["n"])
        assert row["ratio"] == pytest.approx(row["numpy_ms"] / row["ms"])
    assert result["repeat"] == 1
    assert "ns a key" in plot.read_text()
    assert any("10,000" in line for line in bench_sort.table(result))


def test_deviation_from_linear_growth() -> None:
    rows = [{"n": n, "ns_per_key": ns} for n, ns in ((10_000, 90.0), (100_000, 12.0), (300_000, 10.0), (10**6, 15.0))]
    assert bench_sort.deviation(rows) == 1.5
    assert bench_sort.deviation(rows[:2]) is None


def test_pairs_have_ties_that_only_a_stable_sort_keeps() -> None:
    n = 4_000_000  # so many depths that some Gaussians share one
    depths, tiles = bench_sort.random_pairs(n)
    assert len(np.unique(depths)) < len(depths)
    assert tiles.max() < bench_sort.TILES_X * bench_sort.TILES_Y
    assert (tiles[:, 1:] > tiles[:, :-1]).all()


def test_an_order_that_is_not_numpys(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    sort = bench_sort.sort
    monkeypatch.setattr(bench_sort, "sort", lambda *arguments: sort(*arguments[:4], 20))  # leaves high bits unsorted
    assert bench_sort.main(["--max", "1e4", "--repeat", "1"]) == 1
    assert "keys: 10000 of them come out in another order" in one_error(capsys, "bench_sort")


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--max 9999", "--max 9999: expected at least 10000"),
        ("--repeat 0", "--repeat 0: expected at least 1"),
        ("--plot sort.pdf", "sort.pdf"),
        ("--device abacus", "--device abacus: no such device"),
    ],
)
def test_wrong_calls_of_bench_sort(flags: str, message: str, capsys: Capture) -> None:
    assert bench_sort.main(flags.split()) == 2
    assert message in one_error(capsys, "bench_sort")
