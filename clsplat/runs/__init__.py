# SPDX-License-Identifier: Apache-2.0
"""Run folders: settings, model, metrics, checkpoints, evaluation and the scene record."""
