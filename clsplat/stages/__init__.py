# SPDX-License-Identifier: Apache-2.0
"""Launchers of the kernels: a module for each kernel file, forward pass and gradient together."""
