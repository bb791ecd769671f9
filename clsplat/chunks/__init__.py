# SPDX-License-Identifier: Apache-2.0
"""Chunks of a model, neighbours in space: their order, their bounds, and the chunks that a camera may see."""
