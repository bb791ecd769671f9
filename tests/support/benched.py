# SPDX-License-Identifier: Apache-2.0
"""A benchmark that takes a moment: its arguments, and its measurement of the device's limits."""

from __future__ import annotations

from functools import partial

from clsplat.stages.peak import measure_limits

SMALL = ["--gaussians", "400", "--size", "70x50", "--repeat", "1"]
"""Arguments of `clsplat bench`."""

quick_limits = partial(measure_limits, seconds=1e-3, repeat=1, copy_bytes=2**16)
