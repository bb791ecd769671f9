# SPDX-License-Identifier: Apache-2.0
"""Reading and writing of images, frame channels, colour spaces and video."""
