# SPDX-License-Identifier: Apache-2.0
"""Masks and known depths of a scene's photographs."""
