# SPDX-License-Identifier: Apache-2.0
"""The rasterizer's named switches: the default's bits are known, exact switches keep them, others say what they lose."""

from __future__ import annotations

import json
from pathlib import Path

from golden_frames import checksums

from clsplat.device.context import Device


def test_default_bits_are_the_stored_ones(device: Device) -> None:
    wanted = json.loads((Path(__file__).parent / "golden" / "frames.json").read_text())["checksums"]
    assert checksums(device) == wanted, "see tools/make_golden.py if the change is meant to change bits"
