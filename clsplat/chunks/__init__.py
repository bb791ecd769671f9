# SPDX-License-Identifier: Apache-2.0
"""Chunks of a model, neighbours in space: their order, their bounds and records, the chunks that a camera may see, and
those that are on the device."""
