# SPDX-License-Identifier: Apache-2.0
"""Pixels in files: images, the channels of a frame, colour spaces, video."""
