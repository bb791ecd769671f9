# SPDX-License-Identifier: Apache-2.0
"""A small model with chunks, most of which no view of the tiny scene shows, and scratch files that fail."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny import hidden_model

from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.training import moved_rows, trained_model
from clsplat.training.start import Start
from clsplat.training.step import visible_chunks
from clsplat.training.trainer import Trainer

ROWS = 11 * CHUNK_ROWS + 100


def wide_model(rows: int = ROWS, *, around: bool = True) -> Gaussians:
    """The tiny scene's Gaussians many times, at eight places.

    The first place is the scene's, which every view shows, and four are above, which no view shows. Three are around
    it, of which a view shows some, or, if not `around`, above too.
    """
    small, rng = hidden_model(), np.random.default_rng(5)
    rows_of = rng.integers(0, len(small), rows)
    taken = {name: array[rows_of].copy() for name, array in small.arrays().items()}
    model = replace(small, **taken)
    place = np.arange(rows) * 8 // rows
    beside, above = (place > 4) & around, (place > 0) & ((place <= 4) | (not around))
    angle = place * 2 * np.pi / 3
    away = np.column_stack([12 * beside * np.cos(angle), 30 * above, 12 * beside * np.sin(angle)])
    away[:, 0] += 9 * above * place
    model.means += away.astype(np.float32)
    model.means += rng.normal(0, 0.1, model.means.shape).astype(np.float32)
    model.log_scales -= 1
    model.opacity_logits -= 2
    return model


def let_small_models_have_chunks(patch: pytest.MonkeyPatch) -> None:
    """Let a model of more than two chunks be a large one."""
    for module in (visible_chunks, trained_model, moved_rows):
        patch.setattr(module, "ORDERED_ROWS", 2 * CHUNK_ROWS)


def start_wide(patch: pytest.MonkeyPatch, *, around: bool = True) -> None:
    """Let every training start from `wide_model`."""
    start = Trainer._start

    def begin(trainer: Trainer) -> None:
        trainer.begins_with = Start(wide_model(around=around))
        start(trainer)

    patch.setattr(Trainer, "_start", begin)


def flip(path: Path, at: int) -> None:
    """Change a bit of a file."""
    with open(path, "r+b") as file:
        file.seek(at)
        (value,) = file.read(1)
        file.seek(at)
        file.write(bytes([value ^ 16]))


def full(*_: object) -> None:
    """Fail as on a full disk."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


ONE_TRAINING = """
import sys
from pathlib import Path
sys.path[:0] = sys.argv[3:]
import pytest
import wide
from clsplat.api import train
from clsplat.runs.run import Run
from clsplat.scenes.loading import load_scene
patch = pytest.MonkeyPatch()
wide.let_small_models_have_chunks(patch)
wide.start_wide(patch, around=False)
run = Run.open(Path(sys.argv[2]))
run.resuming = bool(run.checkpoints())
print("ready", flush=True)
sys.stdin.readline()
train(load_scene(Path(sys.argv[1])), run.config, run=run, resume=run.resuming, max_host_mem=4 << 20,
      scratch=run.path.parent / "scratch")
"""
"""A training, or its resume, that begins when it is told to."""


def start_training(scene: Path, run: Path) -> subprocess.Popen[str]:
    """A process that waits for a line before it trains."""
    line = [sys.executable, "-c", ONE_TRAINING, str(scene), str(run), str(Path(__file__).parent)]
    return subprocess.Popen(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
