# SPDX-License-Identifier: Apache-2.0
"""The appearance of each photograph, learnt with the model: what a step asks of it, and what a checkpoint holds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from clsplat.config.training import TrainConfig
from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.training.gains import GainsOfAll
from clsplat.training.grids import GridsOfAll
from clsplat.training.ppisp import PpispOfAll

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene


class ViewAppearance(Protocol):
    """The appearance of one view in one step. place: the view's in a batch."""

    @property
    def place(self) -> int: ...

    def on(self, device: Device, values: NDArray[np.float32]) -> ViewAppearance:
        """The same on another device, by `values`, to share colours and to find its gradient."""
        ...

    def values(self) -> NDArray[np.float32]:
        """Values that `on` takes."""
        ...

    def share_colours(
        self, work: Workspace, image: DeviceArray, target: DeviceArray, width: int, height: int
    ) -> DeviceArray:
        """Give the image, or the photograph in the planes of `target`, in their place, the other's colours. Returns
        the image to compare."""
        ...

    def gradient(
        self, work: Workspace, image: DeviceArray, gradient: DeviceArray, width: int, height: int
    ) -> DeviceArray:
        """Make the gradient by the compared image that by the image. Returns what `update` takes."""
        ...

    def update(self, columns: DeviceArray, readback: DeviceArray) -> None:
        """Adam's step; a step by capacity that has stopped changes nothing."""
        ...


class Appearance(Protocol):
    """The appearances of all training views."""

    @property
    def pixel_bytes(self) -> int:
        """Bytes of a pixel on the device."""
        ...

    def of_views(self, views: Sequence[int], step: int) -> Sequence[ViewAppearance]:
        """The appearances of the views of a step, the last of which is number `step`; none where they are the
        model's."""
        ...

    def record(self) -> dict[str, Any] | None:
        """The content of appearance.json; None where there is nothing to write."""
        ...

    def tables(self) -> dict[str, NDArray[Any]]:
        """Arrays of appearance.npz, by name; none where there is no such file."""
        ...

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays of a checkpoint, by name."""
        ...

    def load(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Take the arrays of a checkpoint. Raises ValueError where that is of other photographs."""
        ...


class ModelsOwn:
    """The model's own colours for all views: nothing is learnt."""

    pixel_bytes = 0

    def of_views(self, views: Sequence[int], step: int) -> Sequence[ViewAppearance]:  # noqa: ARG002
        """Nothing."""
        return ()

    def record(self) -> dict[str, Any] | None:
        """Nothing."""
        return None

    def tables(self) -> dict[str, NDArray[Any]]:
        """Nothing."""
        return {}

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Nothing."""
        return {}

    def load(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Take nothing."""


def appearance_of(config: TrainConfig, device: Device, scene: Scene) -> Appearance:
    """The appearances that the settings ask for."""
    if config.appearance == "none":
        return ModelsOwn()
    of_all: dict[str, Callable[[TrainConfig, Device, Scene], Appearance]] = {
        "exposure": GainsOfAll,
        "ppisp": PpispOfAll,
        "grid": GridsOfAll,
    }
    return of_all[config.appearance](config, device, scene)
