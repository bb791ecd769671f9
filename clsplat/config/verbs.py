# SPDX-License-Identifier: Apache-2.0
"""Defaults that several verbs, or a verb and the package, have in common."""

from __future__ import annotations

TEST_EVERY = 8
HOST, PORT = "127.0.0.1", 8080
"""Address and port that the viewer listens on."""
DEMO_ITERATIONS = 2000
"""Steps of `clsplat demo`, about a minute of two cores."""
