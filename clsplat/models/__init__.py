# SPDX-License-Identifier: Apache-2.0
"""Gaussians in files, and what is done to them without a device."""
