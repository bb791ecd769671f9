# SPDX-License-Identifier: Apache-2.0
"""Forks of a process that has used OpenCL: the threads of its drivers are not in them, so that a call would wait for
ever."""

from __future__ import annotations

import os

from clsplat.errors import DeviceError

_owner: list[int] = []


def claim() -> None:
    """Note that OpenCL is used in this process. Raises DeviceError in a fork of one that has."""
    if not _owner:
        _owner.append(os.getpid())
    check()


def check() -> None:
    """Raise DeviceError in a fork of a process that has used OpenCL."""
    if _owner and os.getpid() != _owner[0]:
        raise DeviceError(
            f"process {os.getpid()} was forked from {_owner[0]}, which has used OpenCL, whose drivers do not work in a "
            "fork; expected a process that begins anew: multiprocessing.get_context('spawn') or 'forkserver', "
            "DataLoader(multiprocessing_context='spawn'), or clsplat's first call after the fork"
        )
