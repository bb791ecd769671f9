# SPDX-License-Identifier: Apache-2.0
"""Benchmarks of kernel stages, rasterizer settings and kernel shapes."""
