# SPDX-License-Identifier: Apache-2.0
"""The run folder: settings, model, metrics, checkpoints, evaluation."""

from clsplat.runs.checkpoints import Checkpoint
from clsplat.runs.run import Run, check_output, check_resumed, is_run, model_file

__all__ = ["Checkpoint", "Run", "check_output", "check_resumed", "is_run", "model_file"]
