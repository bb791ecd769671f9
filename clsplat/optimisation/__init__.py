# SPDX-License-Identifier: Apache-2.0
"""Inputs of a training step that are neither settings nor kernels: thresholds of density rules, noise, dropout."""
