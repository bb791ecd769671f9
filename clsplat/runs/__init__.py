# SPDX-License-Identifier: Apache-2.0
"""The run folder: settings, model, metrics, checkpoints, evaluation."""
