# SPDX-License-Identifier: Apache-2.0
"""Comparison of renders with photographs."""
