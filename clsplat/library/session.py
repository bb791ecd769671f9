# SPDX-License-Identifier: Apache-2.0
"""Sessions of the library: an open device with the working memory and the lock that all calls on it share."""

from __future__ import annotations

import os
import threading
from functools import cache
from weakref import finalize

import numpy as np
from numpy.typing import DTypeLike

from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.errors import of_argument
from clsplat.rendering.build_flags import kernel_defines

_PAIR_ARRAY_NAMES = ("ranges", "gaussian_from_sorted", "slot_from_sorted", "cells_from_sorted")
BACKWARD_ARRAY_NAMES = frozenset(("splats", "tile_counts", "first_slots", "transmittance", "stops", *_PAIR_ARRAY_NAMES))
"""Names of the arrays of a forward pass that its gradient reads. Each pass has its own. All other arrays are shared."""
MAX_IDLE_WORKSPACES = 4
"""Maximum number of workspaces of deleted passes that are kept for later passes."""


class PassWorkspace(Workspace):
    """Workspace of a forward pass, for arrays that its gradient reads. Other arrays are in the session's workspace."""

    def __init__(self, device: Device, scratch: Workspace) -> None:
        super().__init__(device)
        self._scratch = scratch

    def array(
        self, name: str, shape: tuple[int, ...], dtype: DTypeLike = np.float32, *, kept: bool = False
    ) -> DeviceArray:
        """Return the array of this name: from this workspace if BACKWARD_ARRAY_NAMES has it, else from the session's.

        kept: True keeps the contents of the array, as in `Workspace.array`.
        """
        if name in BACKWARD_ARRAY_NAMES:
            return super().array(name, shape, dtype, kept=kept)
        return self._scratch.array(name, shape, dtype, kept=kept)


class LibrarySession:
    """A device and its working memory. Only the thread that holds the `lock` may use them.

    All calls share kernels and scratch arrays. This is safe, as the device's queue runs in order.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self.lock = threading.RLock()
        self.scratch = Workspace(device)
        self._idle: list[PassWorkspace] = []

    def workspace(self, owner: object) -> PassWorkspace:
        """Return a workspace for a forward pass.

        owner: the object of the pass. When it is deleted, later passes may use the workspace.
        """
        with self.lock:
            work = self._idle.pop() if self._idle else PassWorkspace(self.device, self.scratch)
        finalize(owner, self._take_back, work).atexit = False
        return work

    def _take_back(self, work: PassWorkspace) -> None:
        if len(self._idle) < MAX_IDLE_WORKSPACES:  # needs no lock, though any thread may call it: append is atomic
            self._idle.append(work)

    def capped(self, alpha_max: float) -> Device:
        """Return the device, with kernels that limit a Gaussian's alpha at a pixel to `alpha_max`."""
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
    """Return the session of an open device, or of the device that a string selects (see `clsplat devices`).

    Each device has one session. Raises DeviceError.
    """
    if isinstance(device, Device):
        return _session(device)
    # Cached, because listing the devices takes as long as projecting 500,000 Gaussians.
    # The environment variables are part of the key, because the selected device and its kernel shape depend on them.
    return _named(device, tuple(os.environ.get(name) for name in _DEVICE_CHOICE_VARIABLES))
