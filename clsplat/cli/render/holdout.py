# SPDX-License-Identifier: Apache-2.0
"""Flags of `clsplat render` for holdouts."""

from __future__ import annotations

from clsplat.config.holdout import HoldoutConfig
from clsplat.errors import InputError


def holdout_settings(pattern: str | None, config: HoldoutConfig, *, deep: bool) -> HoldoutConfig | None:
    """Settings for reading holdouts; None without any. Raises InputError."""
    if pattern is None:
        if config != HoldoutConfig():
            given = f"channel {config.channel}" if config.channel else f"depths {config.depths}"
            raise InputError(f"--holdout.{given}: is for holdouts, expected --holdout with it")
        return None
    if deep:
        raise InputError("--deep and --holdout exclude each other: a deep picture is held out where it is composited")
    return config
