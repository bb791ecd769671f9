# SPDX-License-Identifier: Apache-2.0
"""The tools that measure: what they print, and that wrong results and wrong calls are told."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import bench_growth
import bench_host
import bench_launches
import bench_library
import bench_sort
import compare_peer
import numpy as np
import pytest
from calls import Capture, printed
from measuring import sizes
from tiny import HEIGHT, WIDTH, write_scene

from clsplat.device.context import Device


def one_error(capsys: Capture, tool: str) -> str:
    captured = capsys.readouterr()
    last = captured.err.splitlines()[-1]
    assert captured.out == ""
    assert last.startswith(f"{tool}: error: ")
    return last


def measured(capsys: Capture, tool: ModuleType, *words: object) -> dict[str, Any]:
    """The tool's answer to --json."""
    return json.loads(printed(capsys, [*words, "--json"], call=tool.main).out)


def test_sizes() -> None:
    assert sizes(10_000, 300_000) == [10_000, 30_000, 100_000, 300_000]
    assert sizes(10_000, 29_999) == [10_000]


@pytest.mark.needs("matplotlib")
def test_sort(tmp_path: Path, capsys: Capture) -> None:
    plot = tmp_path / "sort.svg"
    result = measured(capsys, bench_sort, "--max", "3e4", "--repeat", "1", "--plot", plot)
    assert [(row["sort"], row["n"]) for row in result["rows"]] == [
        (name, n) for n in (10_000, 30_000) for name in ("keys", "pairs")
    ]
    for row in result["rows"]:
        assert row["ns_per_key"] == pytest.approx(1e6 * row["ms"] / row["n"])
        assert row["ratio"] == pytest.approx(row["numpy_ms"] / row["ms"])
    assert result["repeat"] == 1
    assert "ns a key" in plot.read_text()
    assert any("10,000" in line for line in bench_sort.table(result))


@pytest.mark.slow
def test_library(capsys: Capture) -> None:
    result = measured(capsys, bench_library, "--gaussians", "300", "--size", "40x30", "--repeat", "1")
    rows = {row["call"]: row for row in result["rows"]}
    bases = {"rasterize, differentiable=False": "Renderer.render", "rasterize": "Rasterizer.forward"}
    for call, base in {**bases, "rasterize, vjp": "Rasterizer.backward"}.items():
        assert rows[call]["ratio"] == pytest.approx(rows[call]["ms"] / rows[base]["ms"])
        assert rows[base]["ratio"] == 1
    assert (result["gaussians"], result["width"], result["height"]) == (300, 40, 30)


@pytest.mark.slow
def test_host(scene_folder: Path, capsys: Capture) -> None:
    """In groups: a step's launches are all replayed, and its camera is on the device."""
    flags = ["--size", WIDTH, "--steps", "20", "--shape", "1x64", "--repeat", "3"]
    result = measured(capsys, bench_host, scene_folder, *flags)
    assert 0 < result["calls"]["launches"] <= 12
    assert result["calls"]["writes"] == 0
    assert (result["calls"]["blocking_reads"], result["calls"]["blocking_writes"]) == (0, 0)
    assert set(result["us"]) == {*bench_host.CAUSES, bench_host.REST}
    assert result["us"]["driver's calls of a replay"] > 0
    assert 0 < result["least_us"] <= result["step_us"]


def test_causes_have_their_own_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cause that calls another has its time without the other's."""
    watch, now = bench_host.Stopwatch(), [0]
    monkeypatch.setattr(bench_host.time, "thread_time_ns", lambda: now[0])

    def busy(us: int) -> None:
        now[0] += 1000 * us

    inner = watch.around("inner", lambda: busy(20))
    watch.around("outer", lambda: (busy(5), inner(), inner()))()
    assert watch.taken == {"inner": 40.0, "outer": 5.0}


def test_launches(capsys: Capture, default_device: Device) -> None:
    ways = measured(capsys, bench_launches, "--repeat", "2")["ways"]
    has_buffers = "cl_khr_command_buffer" in default_device.cl_device.extensions.split()
    assert list(ways) == ["pyopencl, with events", "ctypes, without", "command buffer"][: 2 + has_buffers]
    assert all(0 < row["least_us"] <= row["us"] for row in ways.values())


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
    assert "keys: the order of 10000 differs" in one_error(capsys, "bench_sort")


@pytest.mark.needs("matplotlib")
def test_growth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    for name, value in {"GAUSSIANS": 500, "WIDTH": 80, "HEIGHT": 60, "FEWEST": 100}.items():
        monkeypatch.setattr(bench_growth, name, value)
    monkeypatch.setattr(bench_growth, "MEGAPIXELS", (0.003, 0.006, 0.012, 1.0))
    plot = tmp_path / "growth.svg"
    flags = ["--max-gaussians", "1e3", "--max-megapixels", "0.02", "--repeat", "1", "--plot", plot]
    result = measured(capsys, bench_growth, *flags)
    gaussians, pixels = result["gaussians"], result["pixels"]
    drawn = [[(row["gaussians"], row["width"], row["height"]) for row in part["rows"]] for part in (gaussians, pixels)]
    assert drawn == [[(100, 80, 60), (300, 80, 60), (1000, 80, 60)], [(500, 63, 47), (500, 89, 67), (500, 126, 94)]]
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
    ("tool", "flags", "message"),
    [
        (bench_library, "--gaussians 0", "--gaussians 0: expected at least 1"),
        (bench_library, "--size 0x30", "--size 0x30: expected a width and a height in pixels"),
        (bench_library, "--repeat 0", "--repeat 0: expected at least 1"),
        (bench_host, "scene --steps 9", "--steps 9: expected at least 10"),
        (bench_sort, "--max 9999", "--max 9999: expected at least 10000"),
        (bench_sort, "--repeat 0", "--repeat 0: expected at least 1"),
        (bench_sort, "--plot sort.pdf", "sort.pdf"),
        (bench_sort, "--device abacus", "--device abacus: no such device"),
        (bench_growth, "--max-gaussians 5e4", "--max-gaussians 50000: expected at least 100000"),
        (bench_growth, "--max-megapixels 0.4", "--max-megapixels 0.4: expected at least 0.5"),
        (bench_growth, "--repeat 0", "--repeat 0: expected at least 1"),
        (bench_growth, "--plot nowhere/growth.svg", "nowhere"),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_wrong_calls(tool: ModuleType, flags: str, message: str, capsys: Capture) -> None:
    assert tool.main(flags.split()) == 2
    assert message in one_error(capsys, tool.__name__)


@pytest.fixture
def peer_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A scene that the peer is said to have been measured on."""
    monkeypatch.setattr(compare_peer, "PEERS", {"tiny": compare_peer.Peer(WIDTH, HEIGHT, 40, 0.5)})
    return write_scene(tmp_path / "tiny")


def test_peer_with_a_known_limit(peer_scene: Path, capsys: Capture) -> None:
    result = json.loads(printed(capsys, [peer_scene, "--limit-gpairs", "2.545", "--json"], call=compare_peer.main).out)
    (row,) = result["rows"]
    assert (row["scene"], row["width"], row["height"], row["gaussians"]) == ("tiny", WIDTH, HEIGHT, 40)
    assert row["limits"] == {"given": 2.545}
    assert row["peer_seconds_scaled"] == pytest.approx(1.0)
    assert row["ratio"] == pytest.approx(1000 / row["ms"])
    assert result["repeat"] == 28


@pytest.mark.slow
def test_peer_with_a_program(peer_scene: Path, tmp_path: Path, capsys: Capture) -> None:
    program = tmp_path / "limit.py"
    program.write_text("import sys; print(f'2 threads 8 lanes: {sys.argv[1]} Gpairs/s')")
    line = [str(peer_scene), "--limit", f"{sys.executable} {program} 1000.5"]
    (row,) = json.loads(printed(capsys, [*line, "--json"], call=compare_peer.main).out)["rows"]
    assert row["limit"] == row["limits"]["program"] == 1000.5
    # a program that is slower than what the device has just shown does not make the peer slower
    out = printed(capsys, [peer_scene, "--limit", f"{sys.executable} {program} 0.0001"], call=compare_peer.main).out
    assert "program 0.00, kernel " in out
    assert " 0.00  " not in out


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--limit-gpairs", "0"], "--limit-gpairs 0.0: expected more than 0"),
        (["--limit-gpairs", "1", "--device", "abacus"], "--device abacus: no such device"),
        (["--limit", "/no/such/program"], "--limit /no/such/program: cannot be run"),
        (["--limit", f"{sys.executable} -c print(1)"], "printed '1', expected N Gpairs/s in it"),
        (["--limit", f"{sys.executable} -c 1/0"], "cannot be run"),
        (["--limit", ""], "cannot be run"),
    ],
)
def test_wrong_calls_of_compare_peer(flags: list[str], message: str, peer_scene: Path, capsys: Capture) -> None:
    assert compare_peer.main([str(peer_scene), *flags]) == 2
    assert message in one_error(capsys, "compare_peer")


def test_scenes_that_the_peer_did_not_have(peer_scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    for peer, message in [
        (compare_peer.Peer(WIDTH, HEIGHT, 41, 0.5), "has 40 points, the peer started from 41"),
        (compare_peer.Peer(WIDTH, HEIGHT + 1, 40, 0.5), "00.png: is 48x40, the peer had 48x41"),
    ]:
        monkeypatch.setattr(compare_peer, "PEERS", {"tiny": peer})
        assert compare_peer.main([str(peer_scene), "--limit-gpairs", "1"]) == 2
        assert message in one_error(capsys, "compare_peer")
    monkeypatch.setattr(compare_peer, "PEERS", {"fox": peer})
    assert compare_peer.main([str(peer_scene), "--limit-gpairs", "1"]) == 2
    assert "has not been measured on it, expected one of fox" in one_error(capsys, "compare_peer")
