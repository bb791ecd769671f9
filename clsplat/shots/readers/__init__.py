# SPDX-License-Identifier: Apache-2.0
"""Readers of camera files: cameras.json, clsplat's own JSON, nerfstudio's camera_path.json and USD stages."""
