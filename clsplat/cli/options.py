# SPDX-License-Identifier: Apache-2.0
"""Options shared by several verbs, and the base class of every verb's arguments."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, TypeVar

from tyro.conf import FlagCreatePairsOff, Positional, arg

from clsplat.cli.flags import Groups
from clsplat.config.checks import device_names, parse_bytes
from clsplat.config.cli_defaults import VIEWER_HOST, VIEWER_PORT

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
    """Base class of the arguments of a verb (subcommand), whose module also has a function `run`.

    groups: groups of flags for the help, if the verb has too many flags for one list.
    """

    groups: ClassVar[Groups] = ()

    def completed(self, given: Collection[str]) -> Verb:
        """Return the arguments, with settings of a run or a preset for flags that are not given. Raises InputError.

        given: names of the flags on the command line, such as "rasterizer.alpha_min".
        """
        del given
        return self


@dataclass(frozen=True)
class DeviceChoice:
    """The device to work on."""

    selector: Annotated[str | None, arg(name="device", metavar="DEVICE")] = None
    """OpenCL device: an index, cpu, gpu, or part of a name, as listed by `clsplat devices`. If not given:
    CLSPLAT_DEVICE, else the first GPU, else the first device."""

    def open(self, services: Services) -> Device:
        """Open the device, without the self-test. Raises DeviceError."""
        return services.open_device(self.selector)

    def trusted(self, services: Services, *stages: Sequence[str]) -> Device:
        """Open the device and run the short self-test. Raises InputError, DeviceError and DriverError.

        stages: the names of the stages to test, as one sequence; if not given, the stages of training.
        """
        return services.require(self.open(services), *stages)


@dataclass(frozen=True)
class DeviceOptions(DeviceChoice):
    """The device to work on, and its memory limit."""

    max_device_mem: Memory = None
    """Limit of device memory, such as 256MiB or 2G. Work that needs more is done in pieces: slower, with the same
    result. If not given: all of the device's memory."""

    def open(self, services: Services) -> Device:
        """Open the device with its memory limit, without the self-test. Raises InputError and DeviceError."""
        return services.open_device(self.selector, parse_bytes(self.max_device_mem))

    def check(self) -> None:
        """Raise InputError for a malformed memory limit, before anything is read."""
        parse_bytes(self.max_device_mem)


@dataclass(frozen=True)
class SeveralDevices(DeviceOptions):
    """The devices to work on, and the memory limit of each."""

    selector: Annotated[str | None, arg(name="device", metavar="DEVICE,...")] = None
    """OpenCL device: an index, cpu, gpu, or part of a name, as listed by `clsplat devices`. Several, separated by
    commas, each take one view of a step (see --batch). 0/0,0/1 are the halves of device 0, if its driver can divide it.
    If not given: CLSPLAT_DEVICE, else the first GPU, else the first device."""

    @property
    def count(self) -> int:
        """Number of devices that --device names."""
        return len(device_names(self.selector))

    def open_all(self, services: Services) -> list[Device]:
        """Open the devices with their memory limits, without the self-test. Raises InputError and DeviceError."""
        if self.count == 1:
            return [self.open(services)]
        return services.open_devices(self.selector, parse_bytes(self.max_device_mem))


@dataclass(frozen=True)
class PageOptions:
    """Address of the viewer's page."""

    host: Annotated[str, arg(metavar="ADDRESS")] = VIEWER_HOST
    """Address at which the page is served. By default only this machine can reach it."""
    port: int = VIEWER_PORT
    """Port of the page; 0 takes any free port."""
    paths: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder in which the page may save camera paths. Without it they can still be downloaded."""


def with_given(settings: Settings, parsed: Settings, given: Collection[str], prefix: str = "") -> Settings:
    """Return the settings from the command line, with values of a run or a preset for flags that are not given.

    settings: settings of the run or the preset.
    parsed: settings from the command line, of the same dataclass.
    given: names of the flags on the command line.
    prefix: beginning of the flags' names, such as "rasterizer.".
    """
    changes: dict[str, Any] = {}
    for field in fields(settings):  # type: ignore[arg-type]
        value, flag = getattr(settings, field.name), prefix + field.name
        if is_dataclass(value):
            changes[field.name] = with_given(value, getattr(parsed, field.name), given, f"{flag}.")
        elif flag not in given:
            changes[field.name] = value
    return replace(parsed, **changes)  # type: ignore[type-var]
