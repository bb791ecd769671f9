# SPDX-License-Identifier: Apache-2.0
"""Scenes: photographs with their cameras and points, read from data sets or made by structure from motion."""
