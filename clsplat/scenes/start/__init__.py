# SPDX-License-Identifier: Apache-2.0
"""Initial Gaussians of a training, and the points that they come from."""
