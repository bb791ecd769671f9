# SPDX-License-Identifier: Apache-2.0
"""Density control: policy only, without OpenCL."""
