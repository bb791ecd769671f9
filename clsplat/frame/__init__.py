# SPDX-License-Identifier: Apache-2.0
"""What is made of a rendered frame before it is a file: windows, samples, strips, deep slices."""
