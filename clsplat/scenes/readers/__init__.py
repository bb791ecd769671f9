# SPDX-License-Identifier: Apache-2.0
"""Readers and writers of data sets: COLMAP models, JSON files of Blender and nerfstudio, and surveys."""
