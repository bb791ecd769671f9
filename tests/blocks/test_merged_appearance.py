# SPDX-License-Identifier: Apache-2.0
"""The mean appearance of photographs over the parts of a scene."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from calls import refusal
from compare import assert_same_bits

from clsplat.blocks.merged_appearance import mean_appearance
from clsplat.layouts.columns import GRID_SHAPE

NAMES = ("a", "b", "c", "d")
KNOWN = {"whole": NAMES, "one": ("b", "a"), "other": ("c", "b", "elsewhere")}
"""Photographs of the whole scene and of two parts, which have them in other orders."""


def write_colours(folder: Path, kind: str, first: float) -> Path:
    """Write an appearance.json. Gains are `first` plus 1 for each later photograph."""
    folder.mkdir(parents=True)
    rows: dict[str, dict[str, list[float]]] = {}
    for place, name in enumerate(KNOWN[folder.name]):
        rows[name] = {"log2_gains": [first + place, 0.5, -1.0]}
        if kind == "ppisp":
            vignette = {"vignette": [first, 0.0, 0.0], "centre": [0.5, 0.25]}
            rows[name] |= {"mixes": [0.01 * first] * 6, **vignette}
    (folder / "appearance.json").write_text(json.dumps({"kind": kind, "photographs": rows, "held_out": {}}))
    return folder


def write_grids(folder: Path, first: float) -> Path:
    folder.mkdir()
    places = {name: {"grid": place} for place, name in enumerate(KNOWN[folder.name])}
    (folder / "appearance.json").write_text(json.dumps({"kind": "grid", "photographs": places, "held_out": {}}))
    steps = np.arange(len(places), dtype=np.float32)
    np.savez(folder / "appearance.npz", grids=in_grids(first + steps))
    return folder


def in_grids(values: np.ndarray) -> np.ndarray:
    """Grids (photographs, ...), each of one number."""
    return np.ascontiguousarray(np.broadcast_to(values.reshape(-1, 1, 1, 1, 1, 1), (len(values), *GRID_SHAPE)))


@pytest.mark.parametrize("kind", ["exposure", "ppisp"])
def test_colours(tmp_path: Path, kind: str) -> None:
    whole, one, other = (
        write_colours(tmp_path / name, kind, first) for name, first in zip(KNOWN, (0, 4, -2), strict=True)
    )
    record, tables = mean_appearance(whole, [one, other], kind)
    found = {name: row["log2_gains"][0] for name, row in record["photographs"].items()}
    assert found == {"a": 5.0, "b": (4 - 1) / 2, "c": -2.0, "d": 3.0}
    assert record["photographs"]["b"]["log2_gains"][1:] == [0.5, -1.0]
    assert (record["kind"], record["held_out"], tables) == (kind, {}, {})
    if kind == "ppisp":
        row = record["photographs"]["b"]
        assert (row["vignette"], row["centre"]) == ([1.0, 0.0, 0.0], [0.5, 0.25])
        np.testing.assert_allclose(row["mixes"], [0.01] * 6, rtol=1e-15)  # a sum and a quotient of doubles


def test_grids(tmp_path: Path) -> None:
    whole, one, other = (write_grids(tmp_path / name, first) for name, first in zip(KNOWN, (0, 4, -2), strict=True))
    record, tables = mean_appearance(whole, [one, other], "grid")
    assert record["photographs"] == {name: {"grid": place} for place, name in enumerate(NAMES)}
    wanted = np.array([5.0, 1.5, -2.0, 3.0], np.float32)
    assert_same_bits(tables["grids"], in_grids(wanted))


def test_damaged_grids_are_named(tmp_path: Path) -> None:
    whole, one = (write_grids(tmp_path / name, 0) for name in ("whole", "one"))

    def said() -> str:
        return refusal(lambda: mean_appearance(whole, [one], "grid"))

    np.savez(one / "appearance.npz", grids=in_grids(np.zeros(2, np.float32))[:, :-1])
    assert f"{one / 'appearance.npz'}: ValueError: grids have shape (2, 7, 16, 16, 3, 4), expected finite" in said()
    (one / "appearance.npz").write_bytes(b"PK")
    assert f"{one / 'appearance.npz'}: " in said()
    for row in ({"grid": -1}, {"grid": "b"}, 5):
        (one / "appearance.json").write_text(json.dumps({"kind": "grid", "photographs": {"a": row}}))
        assert f"{one / 'appearance.json'}: " in said()


def test_a_damaged_part_is_named(tmp_path: Path) -> None:
    whole, one = (write_colours(tmp_path / name, "exposure", 0) for name in ("whole", "one"))
    path = one / "appearance.json"

    def said(content: object) -> str:
        path.write_text(json.dumps(content))
        return refusal(lambda: mean_appearance(whole, [one], "exposure"))

    assert f"{path}: is of --appearance grid, expected --appearance exposure" in said({"kind": "grid"})
    rows = {"a": {"log2_gains": [0.0, 1.0]}}
    assert f"{path}: ValueError: expected 3 numbers a photograph" in said({"kind": "exposure", "photographs": rows})
    coarse = whole / "appearance.json"
    content = json.loads(coarse.read_text())
    content["photographs"]["d"] = 5
    coarse.write_text(json.dumps(content))
    assert f"{coarse}: TypeError" in refusal(lambda: mean_appearance(whole, [], "exposure"))
    whole = write_colours(tmp_path / "again" / "whole", "exposure", 0)
    path.unlink()
    assert f"{path}: no such file" in refusal(lambda: mean_appearance(whole, [one], "exposure"))
