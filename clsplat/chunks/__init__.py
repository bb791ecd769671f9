# SPDX-License-Identifier: Apache-2.0
"""Chunks of a model, whose rows are neighbours in space: their order, bounds, records and culling, and which
of them are on the device."""
