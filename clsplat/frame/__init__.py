# SPDX-License-Identifier: Apache-2.0
"""Steps between the kernels and a frame's file: windows, filters, samples, lens warps, strips and deep pictures."""
