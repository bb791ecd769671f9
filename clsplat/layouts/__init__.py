# SPDX-License-Identifier: Apache-2.0
"""Layouts of arrays that Python and the kernels share."""
