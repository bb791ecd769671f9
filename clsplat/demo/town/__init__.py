# SPDX-License-Identifier: Apache-2.0
"""A synthetic town of any size: its blocks, its photographs by ray casting, and its COLMAP scene."""
