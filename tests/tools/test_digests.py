# SPDX-License-Identifier: Apache-2.0
"""tools/ci/digests.py: what it calls a problem. CI runs its short form."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import digests
import pytest
from calls import python
from compare import relative_error
from digests import EXPECTED, IN_SHORT, SAME_ORDER, Job, Row, in_turn, jobs, problems
from golden_frames import SCENES, arrays_of
from pipeline import shaped

from clsplat.config.channels import FRAME_CHANNELS
from clsplat.device.context import Device, all_devices
from clsplat.device.selection import select

ROOT = Path(__file__).resolve().parents[2]

PICTURES = {"perspective": {"rgb": "c", "motion": "v"}, "fisheye": {"rgb": "d"}}
GOOD = Row("A", "8x1", "f", "g8", "m8", True, 20.0, 100, pictures=PICTURES)
ROWS = [GOOD, replace(GOOD, driver="B"), Row("A", "1x64", "f", "g1", "m1", True, 20.1, 101, 5e-7, pictures=PICTURES)]
ROWS.append(replace(ROWS[2], shape="1x256s", model=None))


def test_drivers_take_turns() -> None:
    rows = [("A", "8x1"), ("A", "1x64"), ("B", "8x1"), ("B", "1x64"), ("B", "1x32"), ("Rusticl", "1x64")]
    listed = [Job(driver, 0, shape, train=False, environment={}) for driver, shape in rows]
    begun = [rows[number] for number in in_turn(listed)]
    assert begun[0] == ("Rusticl", "1x64")
    assert begun[1:] == [("A", "8x1"), ("B", "8x1"), ("A", "1x64"), ("B", "1x64"), ("B", "1x32")]


def test_the_short_table_has_every_driver_and_every_shape(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """That is as SAME_ORDER needs it: 1x64 on every driver, and the shapes of its order beside it on the default
    one. None that hangs is waited for."""
    monkeypatch.setenv("CLSPLAT_RUSTICL", "libRusticlOpenCL.so.1")
    (tmp_path / "whole").mkdir()
    (tmp_path / "short").mkdir()
    whole, short = jobs(tmp_path / "whole"), jobs(tmp_path / "short", short=True)
    assert {(job.driver, job.shape) for job in short} <= {(job.driver, job.shape) for job in whole}
    assert {job.driver for job in short} == {job.driver for job in whole}
    assert [job.shape for job in short if job.driver == "Rusticl"] == ["1x64"]
    default = all_devices().index(select(None))
    every = {job.shape for job in whole if job.index == default}
    assert {job.shape for job in short if job.index == default} == every and set(SAME_ORDER) <= every
    for index in {job.index for job in whole} - {-1}:
        there = {job.shape for job in whole if job.index == index}
        assert {job.shape for job in short if job.index == index} >= there & set(IN_SHORT)


def test_no_problem() -> None:
    assert problems(ROWS) == []


@pytest.mark.parametrize(
    ("index", "change", "words"),
    [
        (1, {"frame": "x"}, "B, 8x1: the frame is x, on A, 8x1 it is f"),
        (2, {"frame": "x"}, "A, 1x64: the frame is x"),
        (
            2,
            {"pictures": {"perspective": PICTURES["perspective"], "fisheye": {"rgb": "x"}}},
            "A, 1x64: rgb of the fisheye camera is x, on A, 8x1 it is d",
        ),
        (1, {"pictures": {}}, "B, 8x1: rgb of the perspective camera is missing"),
        (1, {"gradient": "x"}, "B, 8x1: the gradient is x, on A, 8x1 it is g8"),
        (3, {"gradient": "x"}, "A, 1x256s: the gradient is x, on A, 1x64 it is g1"),
        (2, {"difference": 2e-6}, "A, 1x64: the gradient is 2.0e-06 from that of 8x1"),
        (2, {"difference": float("nan")}, "A, 1x64: the gradient is nan"),
        (0, {"repeats": False}, "A, 8x1: two trainings gave two models"),
        (1, {"model": "x"}, "B, 8x1: the model is x, on A, 8x1 it is m8"),
        (2, {"psnr": 18.0}, "A, 1x64: the model has 18.00 dB, that of 8x1 20.00 dB"),
        (2, {"trouble": "ended with status 1"}, "A, 1x64: ended with status 1"),
    ],
)
def test_a_problem(index: int, change: dict[str, object], words: str) -> None:
    rows = list(ROWS)
    rows[index] = replace(rows[index], **change)  # type: ignore[arg-type]
    assert any(text.startswith(words) for text in problems(rows))


def test_a_failure_that_is_expected_has_to_fail() -> None:
    driver, shape = next(iter(EXPECTED))
    row = Row(driver, shape, "f", "g", trouble="known")
    assert problems([*ROWS, row]) == []
    assert "take it from EXPECTED" in problems([*ROWS, replace(row, trouble="", gradient="g1")])[0]


def test_nothing_run() -> None:
    assert problems([Row("A", "8x1", trouble="no")])[-1] == "nothing was run"


def test_tables_have_every_driver() -> None:
    rows = [*ROWS, Row(*next(iter(EXPECTED)), trouble="known")]
    lines = digests.table(rows).splitlines()
    assert f"| 8x1 | A; B | `f` | `{GOOD.channels}` | `g8` | `m8`, 20.000 dB |" in lines
    assert lines[-2:] == ["| perspective | `c` | `v` |", "| fisheye | `d` | not defined |"]


@pytest.mark.slow
def test_a_child(tmp_path: Path) -> None:
    done = python(digests.__file__, "child", "0", "8x1", tmp_path / "arrays.npz")
    told = json.loads(done.stdout.splitlines()[-1])
    assert set(told) == {"frame", "gradient", "pictures"}
    channels = {"deep", *FRAME_CHANNELS}
    kinds = ("perspective", "orthographic", "equirectangular", "fisheye")
    assert {kind: set(each) for kind, each in told["pictures"].items()} == dict.fromkeys(kinds, channels)
    assert (tmp_path / "arrays.npz").exists()
    page = (ROOT / "docs/bit-identity.md").read_text("utf-8").splitlines()
    row = Row("any", "8x1", **told)
    rows = [line for line in page if line.startswith("| 8x1 |") and "not run" not in line]
    assert rows and all(f"| `{row.frame}` | `{row.channels}` | `{row.gradient}` |" in line for line in rows)
    assert set(digests.channel_table(row)) <= set(page)


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(1, 1), (1, 64), (4, 1), (16, 1)], ids=str)
def test_gradients_of_two_shapes(shape: tuple[int, int], default_device: Device) -> None:
    """The order of blending's sums is the shape's: of each parameter group within GRADIENT_BOUND, in norm."""
    wanted, got = arrays_of(shaped(default_device, 8, 1)), arrays_of(shaped(default_device, *shape))
    for scene in SCENES:
        for name in ("gradients", "screen"):
            for a, b in zip(got[scene][name], wanted[scene][name], strict=True):
                assert 0 < relative_error(a, b) <= digests.GRADIENT_BOUND
