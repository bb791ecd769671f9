# SPDX-License-Identifier: Apache-2.0
"""Supervision beside colour: masks and known depths of a scene's photographs."""
