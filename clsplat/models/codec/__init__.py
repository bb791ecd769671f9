# SPDX-License-Identifier: Apache-2.0
"""Conversion of values, axes and byte layouts, for several model formats."""
