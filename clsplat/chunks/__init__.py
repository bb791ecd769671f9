# SPDX-License-Identifier: Apache-2.0
"""Chunks of a model, whose rows are neighbours in space: their order, bounds and records, and which chunks a camera may
see or are on the device."""
