# SPDX-License-Identifier: Apache-2.0
"""Benchmarks of kernel stages and rasterizer settings (`clsplat bench`), and of kernel shapes (`clsplat tune`)."""
