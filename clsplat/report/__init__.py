# SPDX-License-Identifier: Apache-2.0
"""report.html, what a run came to in one file, and runs side by side (docs/report.md).

`figures` reads a run, `svg` draws, `thumbnails` embeds, `page` and `compare` put pages together; `training.telemetry`
is what training notes for them.
"""

from __future__ import annotations

NAME = "report.html"
"""File name of the report in a run's folder."""
