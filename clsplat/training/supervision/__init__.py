# SPDX-License-Identifier: Apache-2.0
"""Photographs and known depths that a training step compares its render with: decoding, caches, resolution."""
