# SPDX-License-Identifier: Apache-2.0
"""Pixels in files: pictures, the channels of a frame, colour spaces, video."""
