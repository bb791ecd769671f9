# SPDX-License-Identifier: Apache-2.0
"""Frames from models, and the plan of the memory that they take."""
