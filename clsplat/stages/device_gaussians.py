# SPDX-License-Identifier: Apache-2.0
"""Parameters, gradients and moments: on the device, or on the host and streamed to the device in parts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from clsplat.device.buffers import DeviceArray, Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS, Gaussians, floats_of, group_shapes
from clsplat.layouts.columns import CHUNK_ROWS


@dataclass(frozen=True, eq=False)
class ShStorage:
    """Storage of the SH coefficients in a model that is only rendered.

    coefficients: number of coefficients per channel.
    degrees: (n,) uint8, the highest degree evaluated for each Gaussian; None evaluates all.
    half: store the bands above 0 as float16.
    """

    coefficients: int
    degrees: NDArray[np.uint8] | None = None
    half: bool = False

    @property
    def floats(self) -> int:
        """Memory per Gaussian, in floats of 4 bytes. The SH degree, if stored, takes one. Coefficients stored as halves
        take half a float each, rounded up in all."""
        rest = 3 * (self.coefficients - 1)
        kept = -(-rest // 2) if self.half else rest
        return floats_of(self.coefficients) - rest + kept + (self.degrees is not None)


A = TypeVar("A")


@dataclass(frozen=True, eq=False)
class _ByGroup(Generic[A]):
    """Parameters, gradients or moments: arrays by group name, whose first axis has length `count`."""

    count: int
    coefficients: int
    arrays: dict[str, A]

    def __getitem__(self, group: str) -> A:
        return self.arrays[group]

    def only(self, *groups: str) -> Self:
        """A copy of this object that has only the arrays of these groups."""
        return replace(self, arrays={group: self.arrays[group] for group in groups})


@dataclass(frozen=True, eq=False)
class DeviceGaussians(_ByGroup[DeviceArray]):
    """Gaussians on the device.

    In a model that is only rendered (`ShStorage`), sh_rest may be float16, and there may be sh_degrees (count) uint8.
    """


@dataclass(frozen=True, eq=False)
class HostArray:
    """A host array with the interface of a DeviceArray."""

    values: NDArray[Any]

    @property
    def shape(self) -> tuple[int, ...]:
        return self.values.shape

    def get(self) -> NDArray[Any]:
        """A copy of the array."""
        return self.values.copy()

    def set(self, values: NDArray[Any]) -> None:
        """Copy the values of another array into this one."""
        self.values[...] = values

    def get_rows(self, start: int, stop: int) -> NDArray[Any]:
        """A copy of the rows [start, stop)."""
        return self.values[start:stop].copy()

    def set_rows(self, start: int, values: NDArray[Any]) -> None:
        """Copy another array into the rows that begin at `start`."""
        self.values[start : start + len(values)] = values

    def fill(self, value: float) -> None:
        """Set every element."""
        self.values.fill(value)


@dataclass(frozen=True, eq=False)
class HostGaussians(_ByGroup[HostArray]):
    """Gaussians on the host; `parts` uploads `rows` of them at a time."""

    rows: int


AnyGaussians = DeviceGaussians | HostGaussians


def parts(
    work: Workspace, *models: AnyGaussians, keep: bool = False
) -> Iterator[tuple[int, int, tuple[DeviceGaussians, ...]]]:
    """Yield (start, stop, the models' rows [start, stop) on the device) for each part in turn.

    Models on the device have a single part. Each part of a host model is valid until the next part is requested.

    keep: copy changes of the part back to the host.
    """
    on_device = tuple(model for model in models if isinstance(model, DeviceGaussians))
    if len(on_device) == len(models):
        yield 0, models[0].count, on_device
        return
    streamed = [model for model in models if isinstance(model, HostGaussians)]
    count, rows = streamed[0].count, streamed[0].rows
    for start in range(0, count, rows):
        stop = min(start + rows, count)
        uploaded = []
        for index, model in enumerate(streamed):
            arrays = {}
            for name, whole in model.arrays.items():
                values = whole.values[start:stop]
                arrays[name] = work.array(f"part{index}_{name}", values.shape, values.dtype)
                arrays[name].set(values)
            uploaded.append(DeviceGaussians(stop - start, model.coefficients, arrays))
        yield start, stop, tuple(uploaded)
        if keep:
            for model, part in zip(streamed, uploaded, strict=True):
                for name, array in part.arrays.items():
                    array.read_into(model[name].values[start:stop])


def upload_chunks(
    work: Workspace, numbers: NDArray[np.uint32], *models: HostGaussians
) -> tuple[tuple[DeviceGaussians, ...], Callable[[], None]]:
    """Upload the rows of these chunks, in rising order, one after the other.

    Returns the models, valid until the next call, and a function that copies their changes back to the host.
    """
    rows = [slice(CHUNK_ROWS * int(number), CHUNK_ROWS * (int(number) + 1)) for number in numbers]
    uploaded, wholes = [], []
    for index, model in enumerate(models):
        arrays = {}
        for name, whole in model.arrays.items():
            some = np.concatenate([whole.values[each] for each in rows])
            arrays[name] = work.array(f"part{index}_{name}", some.shape, some.dtype)
            arrays[name].set(some)
            wholes.append((arrays[name], whole.values))
        uploaded.append(DeviceGaussians(arrays["means"].shape[0], model.coefficients, arrays))

    def copy_back() -> None:
        for array, whole in wholes:
            some, begin = array.get(), 0
            for each in rows:
                end = begin + len(whole[each])
                whole[each] = some[begin:end]
                begin = end

    return tuple(uploaded), copy_back


def allocate_gaussians(device: Device, count: int, coefficients: int, *, zero: bool = False) -> DeviceGaussians:
    """Allocate arrays for `count` Gaussians."""
    arrays = {name: allocate(device, shape, np.float32) for name, shape in group_shapes(count, coefficients).items()}
    if zero:
        for array in arrays.values():
            array.fill(0.0)
    return DeviceGaussians(count, coefficients, arrays)


def _grouped(gaussians: Gaussians, sh: ShStorage) -> dict[str, NDArray[Any]]:
    host = {name: getattr(gaussians, group.field) for name, group in PARAMETER_GROUPS.items()}
    host |= {"sh_dc": gaussians.sh[:, 0], "sh_rest": gaussians.sh[:, 1 : sh.coefficients]}
    kinds = {"sh_rest": np.float16 if sh.half else np.float32}
    arrays = {name: np.ascontiguousarray(values, kinds.get(name, np.float32)) for name, values in host.items()}
    return arrays if sh.degrees is None else {**arrays, "sh_degrees": sh.degrees}


def upload_gaussians(device: Device, gaussians: Gaussians, sh: ShStorage | None = None) -> DeviceGaussians:
    """Upload Gaussians. sh: the SH storage, for a model that is only rendered."""
    sh = sh or ShStorage(gaussians.sh.shape[1])
    arrays = {name: upload(device, values) for name, values in _grouped(gaussians, sh).items()}
    return DeviceGaussians(len(gaussians), sh.coefficients, arrays)


def host_gaussians(gaussians: Gaussians, rows: int, sh: ShStorage | None = None) -> HostGaussians:
    """Gaussians on the host, to be streamed through the device `rows` at a time.

    The arrays are not copied: they are read-only unless the caller may write them.

    sh: the SH storage, for a model that is only rendered.
    """
    sh = sh or ShStorage(gaussians.sh.shape[1])
    arrays = {name: HostArray(values) for name, values in _grouped(gaussians, sh).items()}
    return HostGaussians(len(gaussians), sh.coefficients, arrays, rows)


def host_model(arrays: Mapping[str, NDArray[Any]], kind: str) -> HostGaussians:
    """Gaussians on the host, from the arrays of a checkpoint whose names begin with `kind`/. Raises ValueError for a
    wrong name, shape or dtype."""
    if missing := [group for group in PARAMETER_GROUPS if f"{kind}/{group}" not in arrays]:
        raise ValueError(f"has no {kind}/{missing[0]}")
    host = {group: HostArray(arrays[f"{kind}/{group}"]) for group in PARAMETER_GROUPS}
    count, coefficients = len(host["means"].values), host["sh_rest"].shape[1] + 1
    for group, shape in group_shapes(count, coefficients).items():
        values = host[group].values
        if values.shape != shape or values.dtype != np.float32 or count == 0:
            raise ValueError(f"{kind}/{group} has shape {values.shape} of {values.dtype}, expected {shape} of float32")
    return HostGaussians(count, coefficients, host, count)


def host_zeros(count: int, coefficients: int, rows: int) -> HostGaussians:
    """Arrays of zeros on the host: the initial moments of Adam."""
    shapes = group_shapes(count, coefficients)
    arrays = {name: HostArray(np.zeros(shape, np.float32)) for name, shape in shapes.items()}
    return HostGaussians(count, coefficients, arrays, rows)


def to_host(gaussians: AnyGaussians) -> HostGaussians:
    """A host copy of Gaussians on the device; host Gaussians are returned unchanged."""
    if isinstance(gaussians, HostGaussians):
        return gaussians
    arrays = {name: HostArray(array.get()) for name, array in gaussians.arrays.items()}
    return HostGaussians(gaussians.count, gaussians.coefficients, arrays, gaussians.count)


def to_device(device: Device, gaussians: HostGaussians) -> DeviceGaussians:
    """A device copy of host Gaussians."""
    arrays = {name: upload(device, array.values) for name, array in gaussians.arrays.items()}
    return DeviceGaussians(gaussians.count, gaussians.coefficients, arrays)


def download_gaussians(gaussians: AnyGaussians) -> Gaussians:
    """A host copy as `Gaussians`."""
    host = {name: gaussians[name].get() for name in PARAMETER_GROUPS}
    sh = np.concatenate([host["sh_dc"][:, None], host["sh_rest"]], axis=1)
    return Gaussians(host["means"], host["quaternions"], host["log_scales"], host["opacity_logits"], sh)
