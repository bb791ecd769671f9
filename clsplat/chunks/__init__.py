# SPDX-License-Identifier: Apache-2.0
"""Chunks of a model, neighbours in space: their order, bounds and records; which of them a camera may see; which of
them are on the device."""
