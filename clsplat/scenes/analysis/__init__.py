# SPDX-License-Identifier: Apache-2.0
"""Findings about photographs and cameras before training, and the settings that they recommend."""
