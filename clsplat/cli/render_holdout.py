# SPDX-License-Identifier: Apache-2.0
"""The flags of `clsplat render` for hold-outs."""

from __future__ import annotations

from clsplat.config.holdout import HoldoutConfig
from clsplat.errors import InputError


def holdout_settings(pattern: str | None, config: HoldoutConfig, *, deep: bool) -> HoldoutConfig | None:
    """How hold-outs are read, None where there are none. Raises InputError."""
    if pattern is None:
        if config != HoldoutConfig():
            given = f"channel {config.channel}" if config.channel else f"depths {config.depths}"
            raise InputError(f"--holdout.{given}: is of hold-outs, expected --holdout with it")
        return None
    if deep:
        raise InputError("--deep and --holdout exclude each other: a deep picture is held out where it is composited")
    return config
