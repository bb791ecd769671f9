# SPDX-License-Identifier: Apache-2.0
"""Steps between a rendered frame and its file: windows, filters, samples, warps, strips, deep slices."""
