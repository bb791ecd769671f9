# SPDX-License-Identifier: Apache-2.0
"""Helpers for files: atomic writes, locks, portable names, JSON."""
