# SPDX-License-Identifier: Apache-2.0
"""Supervision of a training in addition to colours: masks and known depths of photographs."""
