# SPDX-License-Identifier: Apache-2.0
"""The tools that measure: what they print, and that wrong results and wrong calls are told."""

from __future__ import annotations

import json
from pathlib import Path

import bench_growth
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


def test_growth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    pytest.importorskip("matplotlib")
    for name, value in {"GAUSSIANS": 500, "WIDTH": 80, "HEIGHT": 60, "FEWEST": 100}.items():
        monkeypatch.setattr(bench_growth, name, value)
    monkeypatch.setattr(bench_growth, "MEGAPIXELS", (0.003, 0.006, 0.012, 1.0))
    plot = tmp_path / "growth.svg"
    flags = ["--max-gaussians", "1e3", "--max-megapixels", "0.02", "--repeat", "1", "--plot", str(plot)]
    assert bench_growth.main([*flags, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    gaussians, pixels = result["gaussians"], result["pixels"]
    assert [(row["gaussians"], row["width"], row["height"]) for row in gaussians["rows"]] == [
        (100, 80, 60),
        (300, 80, 60),
        (1000, 80, 60),
    ]
    assert [(row["gaussians"], row["width"], row["height"]) for row in pixels["rows"]] == [
        (500, 63, 47),
        (500, 89, 67),
        (500, 126, 94),
    ]
    for part in (gaussians, pixels):
        for row in part["rows"]:
            assert row["pairs"] > 0
            fitted = part["ms_at_zero"] + part["ms_per_unit"] * row["x"]
            assert row["residual"] == pytest.approx(fitted / row["ms"] - 1)
        assert part["largest_residual"] in [row["residual"] for row in part["rows"]]
        assert any("largest residual" in line for line in bench_growth.table(part))
    assert "million Gaussians" in plot.read_text()


def test_line_of_relative_residuals() -> None:
    a, b, residuals = bench_growth.fit([1.0, 10.0, 100.0], [7.0, 25.0, 205.0])
    assert (a, b) == pytest.approx((5.0, 2.0))
    np.testing.assert_allclose(residuals, 0, atol=1e-12)
    x, times = np.array([1.0, 10.0, 30.0, 100.0]), np.array([14.0, 25.0, 60.0, 205.0])
    a, b, residuals = bench_growth.fit(x.tolist(), times.tolist())
    best = np.square(residuals).sum()
    for more_a, more_b in ((0.01, 0), (-0.01, 0), (0, 0.001), (0, -0.001)):
        assert np.square((a + more_a + (b + more_b) * x) / times - 1).sum() > best


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--max-gaussians 5e4", "--max-gaussians 50000: expected at least 100000"),
        ("--max-megapixels 0.4", "--max-megapixels 0.4: expected at least 0.5"),
        ("--repeat 0", "--repeat 0: expected at least 1"),
        ("--plot nowhere/growth.svg", "nowhere"),
    ],
)
def test_wrong_calls_of_bench_growth(flags: str, message: str, capsys: Capture) -> None:
    assert bench_growth.main(flags.split()) == 2
    assert message in one_error(capsys, "bench_growth")
