# SPDX-License-Identifier: Apache-2.0
"""Orientation and scale of a scene: upright axes, the ground at zero, metres, and the record of the change."""
