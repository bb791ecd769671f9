# SPDX-License-Identifier: Apache-2.0
"""A town of any size, to try large scenes on: its blocks, its photographs by ray casting, and its COLMAP scene."""
