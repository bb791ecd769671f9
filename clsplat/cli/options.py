# SPDX-License-Identifier: Apache-2.0
"""Options that several verbs have in common, and the base of every verb's arguments."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, TypeVar

from tyro.conf import FlagCreatePairsOff, Positional, arg

from clsplat.cli.flags import Groups
from clsplat.config.checks import device_names, parse_bytes
from clsplat.config.verbs import HOST, PORT

if TYPE_CHECKING:
    from clsplat.cli.session import Services
    from clsplat.device.context import Device

Flag = Annotated[bool, FlagCreatePairsOff]
Output = Annotated[Path, arg(aliases=("-o",), metavar="DIR")]
OutputFile = Annotated[Path | None, arg(aliases=("-o",), metavar="FILE")]
RunOrModel = Annotated[Positional[Path], arg(metavar="RUN|MODEL")]
ScenePath = Annotated[Path | None, arg(metavar="SCENE")]
OptionalInt = Annotated[int | None, arg(metavar="INT")]
Memory = Annotated[str | None, arg(metavar="SIZE")]
Settings = TypeVar("Settings")


class Verb:
    """Arguments of a verb. Its module in `clsplat.cli` has the verb's name, and a function `run` that does it. groups:
    of its help, where its flags are too many for one list."""

    groups: ClassVar[Groups] = ()

    def completed(self, given: Collection[str]) -> Verb:
        """The arguments with the settings of a run or a bundle where no flag is `given`. Raises InputError."""
        del given
        return self


@dataclass(frozen=True)
class DeviceChoice:
    """The device to work on."""

    selector: Annotated[str | None, arg(name="device", metavar="DEVICE")] = None
    """OpenCL device: an index, cpu, gpu, or a part of a name, as `clsplat devices` lists them.
    If not given: CLSPLAT_DEVICE, else the first GPU, else the first device."""

    def open(self, services: Services) -> Device:
        """The device, not yet tested. Raises DeviceError."""
        return services.open_device(self.selector)

    def trusted(self, services: Services, *stages: Sequence[str]) -> Device:
        """The device after the short self-test. Raises InputError, DeviceError and DriverError."""
        return services.require(self.open(services), *stages)


@dataclass(frozen=True)
class DeviceOptions(DeviceChoice):
    """The device to work on, and how much of its memory to use."""

    max_device_mem: Memory = None
    """Most device memory to use, such as 256MiB or 2G. What needs more is done in pieces: slower, with the same result.
    If not given: all that the device has."""

    def open(self, services: Services) -> Device:
        """The device with its memory limit, not yet tested. Raises InputError and DeviceError."""
        return services.open_device(self.selector, parse_bytes(self.max_device_mem))

    def check(self) -> None:
        """Raise InputError for a limit that is no size, before anything is read."""
        parse_bytes(self.max_device_mem)


@dataclass(frozen=True)
class SeveralDevices(DeviceOptions):
    """The devices to work on, and how much of the memory of each to use."""

    selector: Annotated[str | None, arg(name="device", metavar="DEVICE,...")] = None
    """OpenCL device: an index, cpu, gpu, or a part of a name, as `clsplat devices` lists them; several, with commas,
    have a view of each step (see --batch), and 0/0,0/1 are the halves of device 0, where its driver divides it.
    If not given: CLSPLAT_DEVICE, else the first GPU, else the first device."""

    @property
    def count(self) -> int:
        """Number of devices that are named."""
        return len(device_names(self.selector))

    def open_all(self, services: Services) -> list[Device]:
        """The devices with their memory limits, not yet tested. Raises InputError and DeviceError."""
        if self.count == 1:
            return [self.open(services)]
        return services.open_devices(self.selector, parse_bytes(self.max_device_mem))


@dataclass(frozen=True)
class PageOptions:
    """Address of a page for the browser."""

    host: Annotated[str, arg(metavar="ADDRESS")] = HOST
    """Address that the page is served at: this machine alone, unless another is given."""
    port: int = PORT
    """Port of the page; 0 is any that is free."""
    paths: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder in which the page may save camera paths; they can be downloaded without it."""


def with_given(settings: Settings, parsed: Settings, given: Collection[str], prefix: str = "") -> Settings:
    """The settings of a run or a bundle, and of the command line those whose flags are `given`."""
    changes: dict[str, Any] = {}
    for field in fields(settings):  # type: ignore[arg-type]
        value, flag = getattr(settings, field.name), prefix + field.name
        if is_dataclass(value):
            changes[field.name] = with_given(value, getattr(parsed, field.name), given, f"{flag}.")
        elif flag not in given:
            changes[field.name] = value
    return replace(parsed, **changes)  # type: ignore[type-var]
