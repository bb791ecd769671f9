# SPDX-License-Identifier: Apache-2.0
"""Differentiable rasterization of arrays: the stages of a view, each with its vector-Jacobian product."""
