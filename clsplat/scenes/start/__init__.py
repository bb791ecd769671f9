# SPDX-License-Identifier: Apache-2.0
"""Initial Gaussians of a training."""
