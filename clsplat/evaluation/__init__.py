# SPDX-License-Identifier: Apache-2.0
"""Renders against photographs."""
