# SPDX-License-Identifier: Apache-2.0
"""An open device for the library's calls, with the memory that they work in."""

from __future__ import annotations

import os
import threading
from functools import cache
from weakref import finalize

import numpy as np
from numpy.typing import DTypeLike

from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device, open_device
from clsplat.errors import of_argument
from clsplat.rendering.build_flags import kernel_defines

_PAIRS = ("ranges", "gaussian_from_sorted", "slot_from_sorted", "cells_from_sorted")
KEPT = frozenset(("splats", "tile_counts", "first_slots", "transmittance", "stops", *_PAIRS))
"""Arrays of a forward pass that its gradient reads: each pass has its own. All else is the session's."""
MOST_IDLE = 4
"""Workspaces of passes that are gone, for those to come."""


class PassWorkspace(Workspace):
    """The arrays of one pass that its gradient reads, and the session's for the rest."""

    def __init__(self, device: Device, scratch: Workspace) -> None:
        super().__init__(device)
        self._scratch = scratch

    def array(
        self, name: str, shape: tuple[int, ...], dtype: DTypeLike = np.float32, *, kept: bool = False
    ) -> DeviceArray:
        """An array by its name, as of any workspace."""
        if name in KEPT:
            return super().array(name, shape, dtype, kept=kept)
        return self._scratch.array(name, shape, dtype, kept=kept)


class Session:
    """A device and its memory for calls from one thread at a time, which hold the `lock`.

    Kernels, their arguments and the scratch arrays are shared by all calls, in the order of the device's queue.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self.lock = threading.RLock()
        self.scratch = Workspace(device)
        self._idle: list[PassWorkspace] = []

    def workspace(self, owner: object) -> PassWorkspace:
        """Memory for a pass, until its owner is gone."""
        with self.lock:
            work = self._idle.pop() if self._idle else PassWorkspace(self.device, self.scratch)
        finalize(owner, self._take_back, work).atexit = False
        return work

    def _take_back(self, work: PassWorkspace) -> None:
        if (
            len(self._idle) < MOST_IDLE
        ):  # one append is one step of the interpreter: no lock, as it may come from anywhere
            self._idle.append(work)

    def capped(self, alpha_max: float) -> Device:
        """The device with kernels that cap alpha at this, for blending and its gradient: other kernels do not look at
        the cap."""
        defines = kernel_defines(RasterizerConfig(), alpha_max=alpha_max)
        return self.device.with_switches(defines) if defines else self.device


@cache
def _session(device: Device) -> Session:
    return Session(device)


_CHOOSE = ("CLSPLAT_DEVICE", "CLSPLAT_SHAPE", "CLSPLAT_PRETEND")


@cache
def _named(selector: str | None, _variables: tuple[str | None, ...]) -> Session:
    with of_argument():
        return _session(open_device(selector))


def session_of(device: Device | str | None = None) -> Session:
    """The session of an open device, or of the one that a text names (see `clsplat devices`); one for each device.
    Raises DeviceError."""
    if isinstance(device, Device):
        return _session(device)
    # looking at every driver again would take as long as projecting half a million Gaussians
    return _named(device, tuple(os.environ.get(name) for name in _CHOOSE))
