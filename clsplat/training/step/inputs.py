# SPDX-License-Identifier: Apache-2.0
"""Inputs of a view in a training step, the parts of components in it, and the rows of the model that it changes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.stages.adam import AdamStep
from clsplat.stages.chunk_lists import ChunkList, ChunkNumbers
from clsplat.stages.device_gaussians import AnyGaussians, DeviceGaussians
from clsplat.stages.loss_terms import DepthTerm
from clsplat.stages.project import Projected, Screen, Slots, ViewSlots


@dataclass(frozen=True, eq=False)
class PlacedChunks:
    """Chunks that a step runs over, ready for its kernels.

    model: the arrays that the kernels get: those of the whole model, or of the pool if the model is streamed.
    in_model: a `ChunkList`: the chunks' numbers in the whole model, or their slots in the pool. If the pool has too few
        slots for all chunks, `in_model` is a `ChunkNumbers`, and `model` is the streamed model, whose chunks come to
        the pool in parts.
    """

    model: tuple[AnyGaussians, ...]
    in_model: ChunkList | ChunkNumbers


class ChunksInView(Protocol):
    """Chunks of the model that a step runs over."""

    @property
    def numbers(self) -> NDArray[np.uint32]:
        """Numbers of the chunks that any view of the step may show, in rising order."""

    @property
    def in_view(self) -> NDArray[np.uint32]:
        """Numbers of the chunks that this view may show, in rising order."""

    def prepare(self, model: tuple[AnyGaussians, ...], step: AdamStep) -> PlacedChunks | None:
        """Make all chunks of the step ready for Adam's step `step`. Call it once in a step. Returns None if the step
        runs over the whole model instead.

        model: parameters, first and second moments.
        """

    def place(self, model: tuple[AnyGaussians, ...]) -> PlacedChunks:
        """Send the list of this view's chunks to the device, after `prepare`. For a streamed model, bring the chunks to
        the pool."""


@dataclass(eq=False)
class ViewInputs:
    """Inputs of a view in a step. The dataclass is not frozen, because each step makes one, and frozen ones take
    longer.

    view: the view's index among the training views.
    photograph: (H, W, 3 to 5): colours, then alpha and mask.
    camera: the view's camera, of the photograph's size.
    begins: True if an epoch begins with this view.
    kept: number of pixels that the view's mask keeps; None without a mask.
    depth: depth loss with the view's known depths; None without --depth.
    area: number of pixels at full resolution per pixel of `photograph`.
    place: the view's position in the step.
    parts: the parts that components have in the view.
    name: the view's name, for messages.
    chunks: the chunks of the model that the view may show; None if the step runs over the whole model.
    """

    view: int
    photograph: NDArray[Any] | DeviceArray
    camera: Camera
    background: NDArray[np.float32]
    begins: bool = False
    kept: int | None = None
    depth: DepthTerm | None = None
    area: float = 1.0
    place: int = 0
    parts: tuple[ViewPart, ...] = ()
    name: str = ""
    chunks: ChunksInView | None = None


@dataclass(frozen=True, eq=False)
class ViewRows:
    """Rows [start, stop) of a step that are on the device at once. The step's rows are all rows of the model, or all
    rows of some chunks, one chunk after the other.

    projected: projection of the rows [start, stop) into the step's view.
    screen: screen-space gradients of these rows. They may be undefined until the kernel that changes the rows has run.
    """

    start: int
    stop: int
    projected: Projected
    screen: Screen


@dataclass(frozen=True, eq=False)
class StepRows(ViewRows):
    """Rows of the model, with all that a step needs to change them.

    model: parameters of the rows, then the arrays that the step changes too: moments, or sums of gradients.
    device: the device, with the kernels for the view's projection.
    camera_array, slots: the step's camera on the device, and the gradients of the rows' pairs.
    gradients: gradients with respect to the rows' parameters; None if nothing reads them.
    by_lens: (rows, 4), gradients with respect to the view's lens; None if lenses are not refined.
    """

    model: tuple[DeviceGaussians, ...]
    device: Device
    camera_array: DeviceArray
    slots: Slots
    gradients: DeviceGaussians | None
    by_lens: DeviceArray | None = None

    @property
    def parameters(self) -> DeviceGaussians:
        """Parameters of these rows: the first element of `model`."""
        return self.model[0]

    @property
    def view(self) -> ViewSlots:
        """The rows' projection and slots, for the gradient of projection."""
        return ViewSlots(self.camera_array, self.projected, self.slots)


class ViewPart:
    """Part that a component has in one view of a step. By default no method does anything."""

    wants_gradients = False
    """True if `add_rows` reads the rows' gradients."""
    changes_rows = False
    """True if `before_adam` changes rows."""
    changes_target = False
    """True if `compare` changes the photograph."""

    def on(self, device: Device, values: NDArray[np.float32]) -> ViewPart:  # noqa: ARG002
        """Return a copy of the part on another device, for `compare` and `gradient` there.

        values: the part's parameters on the host, as the method `values` returned them.
        """
        return self

    def values(self) -> NDArray[np.float32]:
        """The part's parameters on the host, from which `on` makes a copy."""
        return np.zeros(0, np.float32)

    def compare(self, work: Workspace, image: DeviceArray, target: DeviceArray, size: tuple[int, int]) -> DeviceArray:  # noqa: ARG002
        """Match the colours of image and photograph: return another image, or change `target` in place.

        target: the photograph. It is planes (3 or 4, rows, stride) if any part of the view has `changes_target`.
        size: width and height of both in pixels, without padding.
        Returns the image to compare.
        """
        return image

    def gradient(
        self,
        work: Workspace,  # noqa: ARG002
        image: DeviceArray,  # noqa: ARG002
        gradient: DeviceArray,  # noqa: ARG002
        size: tuple[int, int],  # noqa: ARG002
    ) -> DeviceArray | None:
        """Return the gradient with respect to the part's own parameters. In place, convert `gradient` from the gradient
        with respect to the result of `compare` to the one with respect to `image`.

        size: width and height of the image in pixels, without padding.
        """
        return None

    def lens_gradients(self, rows: int) -> DeviceArray | None:  # noqa: ARG002
        """Array (rows, 4) for each Gaussian's gradient with respect to the lens; None if the part does not need it."""
        return None

    def add_rows(self, rows: StepRows) -> None:
        """Add the gradients of these rows to the part's sums. Called before the rows change."""

    def before_adam(self, rows: StepRows, step: AdamStep) -> None:
        """Change these rows just before Adam does. It is called twice if the sandbox tries the step first."""

    def update(self, own: DeviceArray | None, readback: DeviceArray) -> None:
        """Take Adam's step for the part's own parameters.

        own: gradient of these parameters.
        readback: counts of the step's pass on the device. If they say that the pass has stopped, nothing changes.
        """
