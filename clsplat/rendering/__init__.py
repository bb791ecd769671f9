# SPDX-License-Identifier: Apache-2.0
"""Rendering of models to frames, and the plan of the device memory for it."""
