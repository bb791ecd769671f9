# SPDX-License-Identifier: Apache-2.0
"""An open device for the library's calls, with its working memory."""

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

_PAIR_ARRAY_NAMES = ("ranges", "gaussian_from_sorted", "slot_from_sorted", "cells_from_sorted")
BACKWARD_ARRAY_NAMES = frozenset(("splats", "tile_counts", "first_slots", "transmittance", "stops", *_PAIR_ARRAY_NAMES))
"""Arrays of a forward pass that its gradient reads; each pass has its own. Passes share all other arrays."""
MAX_IDLE_WORKSPACES = 4
"""Largest number of workspaces of finished passes that are kept for later passes."""


class PassWorkspace(Workspace):
    """The arrays of one pass that its gradient reads; other arrays are in the session's workspace."""

    def __init__(self, device: Device, scratch: Workspace) -> None:
        super().__init__(device)
        self._scratch = scratch

    def array(
        self, name: str, shape: tuple[int, ...], dtype: DTypeLike = np.float32, *, kept: bool = False
    ) -> DeviceArray:
        """An array by its name. Those of BACKWARD_ARRAY_NAMES are this workspace's own; others are the scratch's."""
        if name in BACKWARD_ARRAY_NAMES:
            return super().array(name, shape, dtype, kept=kept)
        return self._scratch.array(name, shape, dtype, kept=kept)


class LibrarySession:
    """A device and its working memory. Calls come from one thread at a time, which holds the `lock`.

    Kernels, their arguments and the scratch arrays are shared by all calls, in the order of the device's queue.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self.lock = threading.RLock()
        self.scratch = Workspace(device)
        self._idle: list[PassWorkspace] = []

    def workspace(self, owner: object) -> PassWorkspace:
        """A workspace for a pass. When `owner` is garbage-collected, later passes may use the workspace."""
        with self.lock:
            work = self._idle.pop() if self._idle else PassWorkspace(self.device, self.scratch)
        finalize(owner, self._take_back, work).atexit = False
        return work

    def _take_back(self, work: PassWorkspace) -> None:
        if len(self._idle) < MAX_IDLE_WORKSPACES:  # append is atomic: no lock, as a finalizer runs in any thread
            self._idle.append(work)

    def capped(self, alpha_max: float) -> Device:
        """The device with kernels that cap alpha at this value, for blending and its gradient. Other kernels ignore the
        cap.
        """
        defines = kernel_defines(RasterizerConfig(), alpha_max=alpha_max)
        return self.device.with_switches(defines) if defines else self.device


@cache
def _session(device: Device) -> LibrarySession:
    return LibrarySession(device)


_DEVICE_CHOICE_VARIABLES = ("CLSPLAT_DEVICE", "CLSPLAT_SHAPE", "CLSPLAT_PRETEND")


@cache
def _named(selector: str | None, _variables: tuple[str | None, ...]) -> LibrarySession:
    with of_argument():
        return _session(open_device(selector))


def session_of(device: Device | str | None = None) -> LibrarySession:
    """The session of an open device, or of the device that a string selects (see `clsplat devices`).

    There is one session per device.

    Raises DeviceError.
    """
    if isinstance(device, Device):
        return _session(device)
    # the variables are part of the cache's key; listing all drivers again takes as long as projecting 500,000 Gaussians
    return _named(device, tuple(os.environ.get(name) for name in _DEVICE_CHOICE_VARIABLES))
