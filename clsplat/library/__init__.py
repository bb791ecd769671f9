# SPDX-License-Identifier: Apache-2.0
"""Differentiable rasterization of arrays: each step from Gaussians to pixels has a vector-Jacobian product."""
