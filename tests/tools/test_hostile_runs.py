# SPDX-License-Identifier: Apache-2.0
"""Hostile runs: settings, metrics, checkpoints, and results of structure from motion that are none."""

from __future__ import annotations

import struct
import warnings
import zipfile
from pathlib import Path
from typing import Any

import calls
import numpy as np
import pytest
from calls import refusal, warned
from hostile import (
    make_run,
)
from spoilers import npy

from clsplat.config.training import TrainConfig
from clsplat.runs import run as runs
from clsplat.scenes.sfm import reconstruct


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ('clsplat = "1"\n[train]\niterations = ' + "9" * 400, "iterations"),
        ('clsplat = "1"\n[train]\niterations = ' + "9" * 5000, "TOML"),
        ('clsplat = "1"\n[train.optimiser]\nbeta1 = nan', "beta1"),
        ('clsplat = "1"\n[train.density]\nsplit_factor = ' + "9" * 400, "split_factor"),
        ('clsplat = "1"\nx = ' + "[" * 5000 + "]" * 5000, "TOML"),
    ],
    ids=["long", "longer", "nan", "long float", "nested"],
)
def test_settings_that_are_none(text: str, named: str, tmp_path: Path) -> None:
    make_run(tmp_path)
    path = tmp_path / "run/config.toml"
    path.write_text(text)
    message = refusal(lambda: runs.Run.open(path.parent))
    assert str(path) in message
    assert named in message


@pytest.mark.parametrize(
    "line", ['{"step": [1]}', '{"step": "1"}', '{"step": true}', '{"step": null}', "[" * 50_000, "[]"]
)
def test_metrics_that_are_none_are_left_out(line: str, tmp_path: Path) -> None:
    make_run(tmp_path)
    run = runs.Run.open(tmp_path / "run")
    with open(run.metrics_path, "a") as file:
        file.write(f'{line}\n{{"step": 9}}\n')
    assert [record["step"] for record in run.read_metrics()] == [1, 2, 9]
    run.truncate_metrics(2)
    assert run.metrics_path.read_text().count("\n") == 2
    run.eval_path.write_text(line)
    assert run.model_record()["step"] == 2


def archive(path: Path, members: list[tuple[str, bytes]], *, packed: bool = False) -> None:
    compression = zipfile.ZIP_DEFLATED if packed else zipfile.ZIP_STORED
    with warnings.catch_warnings(), zipfile.ZipFile(path, "w", compression) as file:
        warnings.simplefilter("ignore")
        for name, data in members:
            file.writestr(name, data)


def state(text: bytes) -> tuple[str, bytes]:
    return ("state.json.npy", npy(np.frombuffer(text, np.uint8)))


GOOD = state(b'{"step": 2, "state": {}}')
WEIGHTS = npy(np.arange(12, dtype=np.float32).reshape(4, 3))
CHECKPOINTS: dict[str, list[tuple[str, bytes]]] = {
    "claim": [GOOD, ("a.npy", WEIGHTS.replace(b"(4, 3), }   ", b"(40000000, 3), }"[:12] + b"   "))],
    "packed": [GOOD, ("a.npy", npy(np.zeros(10**6)))],
    "pickle": [GOOD, ("a.npy", npy(np.array([{}], object), allow_pickle=True))],
    "twice": [GOOD, ("a.npy", WEIGHTS), ("a.npy", WEIGHTS)],
    "foreign": [GOOD, ("../../a", WEIGHTS)],
    "no state": [("a.npy", WEIGHTS)],
    "nested": [state(b"[" * 100_000)],
    "no step": [state(b'{"step": "2", "state": {}}')],
    "negative step": [state(b'{"step": -2, "state": {}}')],
    "infinite step": [state(b'{"step": 1e999, "state": {}}')],
    "no dictionary": [state(b'{"step": 2, "state": []}')],
}


@pytest.mark.parametrize("kind", CHECKPOINTS)
def test_checkpoints_that_are_none_are_passed_over(kind: str, tmp_path: Path) -> None:
    make_run(tmp_path)
    run = runs.Run.open(tmp_path / "run")
    archive(run.checkpoints_path / "step-0000002.npz", CHECKPOINTS[kind], packed=kind == "packed")
    checkpoint = warned("is a damaged checkpoint", run.load_latest_checkpoint)
    assert checkpoint.step == 1


def test_a_checkpoint_may_be_made_so(tmp_path: Path) -> None:
    make_run(tmp_path)
    run = runs.Run.open(tmp_path / "run")
    archive(run.checkpoints_path / "step-0000002.npz", [GOOD, ("a.npy", WEIGHTS)])
    checkpoint = run.load_latest_checkpoint()
    np.testing.assert_array_equal(checkpoint.arrays["a"], np.arange(12, dtype=np.float32).reshape(4, 3))
    checkpoint.arrays["a"][0] = 1  # training goes on in it


@pytest.mark.parametrize(
    "array",
    [
        *(np.float32(3), np.zeros((0, 3)), np.ones(4, bool), np.asfortranarray(np.ones((4, 3)))),
        *(np.arange(3, dtype=">u2"), np.zeros(2, complex)),
    ],
)
def test_every_array_of_numbers_comes_back(array: Any, tmp_path: Path) -> None:
    run = runs.Run.create(tmp_path / "run", TrainConfig())
    run.save_checkpoint(1, {"a": np.asarray(array)}, {})
    checkpoint = run.load_latest_checkpoint()
    assert checkpoint.arrays["a"].dtype == array.dtype
    np.testing.assert_array_equal(checkpoint.arrays["a"], array)


def test_a_checkpoints_directory_claims_at_most_what_it_has(tmp_path: Path) -> None:
    make_run(tmp_path)
    path = tmp_path / "run/checkpoints/step-0000002.npz"
    data = bytearray(path.read_bytes())
    end = data.rindex(b"PK\5\6")
    data[end + 12 : end + 16] = struct.pack("<I", 0xFFFFFFF0)
    path.write_bytes(data)
    with pytest.warns(UserWarning, match="is a damaged checkpoint"):
        assert calls.peak_of(runs.Run.open(tmp_path / "run").load_latest_checkpoint) < 1e7


# Results of structure from motion


@pytest.mark.parametrize(
    "text", ["{}", "[]", "null", "[" * 100_000, '{"fingerprint": 3}', '{"fingerprint": "0", "files": [3]}', "{"]
)
def test_records_that_are_none(text: str, tmp_path: Path) -> None:
    (tmp_path / "sfm.json").write_text(text)
    refused = refusal(lambda: reconstruct._is_finished(tmp_path, tmp_path / "photos", "0", overwrite=False))
    assert str(tmp_path) in refused
