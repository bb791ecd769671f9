# SPDX-License-Identifier: Apache-2.0
"""Readers of cameras from survey programs: OpenSfM, WebODM, Metashape, RealityScan."""
