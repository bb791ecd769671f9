# SPDX-License-Identifier: Apache-2.0
"""Differentiable rasterization of arrays: each stage of a view has a vector-Jacobian product."""
