# SPDX-License-Identifier: Apache-2.0
"""Photographs and depths that a step compares with, at the current resolution."""
