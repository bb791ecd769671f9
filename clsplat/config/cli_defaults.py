# SPDX-License-Identifier: Apache-2.0
"""Defaults shared by several verbs, or by a verb and the package."""

from __future__ import annotations

TEST_EVERY = 8  # llffhold in the 3DGS authors' code
"""Default of --test-every: every eighth view in the order of names is held out, starting with the first."""
TEST_MOST = 200
"""Default of --test-most: the maximum number of held-out views."""
VIEWER_HOST, VIEWER_PORT = "127.0.0.1", 8080
"""Address and port of the viewer's server."""
DEMO_ITERATIONS = 2000
"""Training steps of `clsplat demo`, which take about a minute on two cores."""
CAPTURE_ITERATIONS = 7000
"""Training steps of `clsplat capture`, for which the short schedule is made."""
