# SPDX-License-Identifier: Apache-2.0
"""Inputs of a training step that follow from the settings: thresholds of density rules, noise, penalties, dropout."""
