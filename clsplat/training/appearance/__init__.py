# SPDX-License-Identifier: Apache-2.0
"""Learnt appearance: exposure gains, cameras' own colour processing, bilateral grids."""
