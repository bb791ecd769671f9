# SPDX-License-Identifier: Apache-2.0
"""Refinement of poses and intrinsics, and the validation of refined cameras with held-out views."""
