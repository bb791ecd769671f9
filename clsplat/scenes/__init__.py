# SPDX-License-Identifier: Apache-2.0
"""Photographs, their cameras and points: read from files, or made by structure from motion."""
