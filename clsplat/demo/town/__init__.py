# SPDX-License-Identifier: Apache-2.0
"""Synthetic town of any size (`clsplat demo --town`): blocks of houses, ray-cast photographs, and a COLMAP scene."""
