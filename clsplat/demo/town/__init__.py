# SPDX-License-Identifier: Apache-2.0
"""A synthetic town of any size, for tests of large scenes: its blocks, its ray-cast photographs, its COLMAP scene."""
