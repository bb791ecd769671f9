# SPDX-License-Identifier: Apache-2.0
"""Check that this process is not a fork of a process that has used OpenCL. A fork does not have the driver's threads,
so that an OpenCL call in it would wait forever."""

from __future__ import annotations

import os

from clsplat.errors import DeviceError

_owner: list[int] = []


def claim() -> None:
    """Record that this process uses OpenCL. Raises DeviceError in a fork of a process that has used it."""
    if not _owner:
        _owner.append(os.getpid())
    check()


def check() -> None:
    """Raise DeviceError in a fork of a process that has used OpenCL."""
    if _owner and os.getpid() != _owner[0]:
        raise DeviceError(
            f"process {os.getpid()} was forked from {_owner[0]}, which has used OpenCL; OpenCL drivers do not work "
            "in a fork. Use a process that starts anew: multiprocessing.get_context('spawn') or 'forkserver', "
            "DataLoader(multiprocessing_context='spawn'), or make clsplat's first call after the fork"
        )
