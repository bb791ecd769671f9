# SPDX-License-Identifier: Apache-2.0
"""Advice on installing an OpenCL driver: the end of the message that there is none."""

from __future__ import annotations

import platform

from clsplat.errors import DeviceError


def driver_advice(system: str | None = None, machine: str | None = None) -> str:
    """Advice on what to install, in a line without a full stop.

    system, machine: as `platform.system` and `platform.machine` give them; this one's unless given.
    """
    system, machine = system or platform.system(), (machine or platform.machine()).lower()
    pc = machine in ("x86_64", "amd64")
    if system == "Darwin":
        return "take conda-forge's packages, with a driver for the CPU: conda install pyopencl pocl (see README)"
    if system == "Windows" and pc:
        cpu = ", or one for the CPU: pip install intel-opencl-rt (an administrator has to register it, see README)"
    elif system == "Windows":
        cpu = ""
    elif system == "Linux" and pc:
        cpu = ", or one for the CPU: pip install 'pyopencl[pocl]'"
    else:
        cpu = ", or one for the CPU: your distribution's PoCL, such as apt install pocl-opencl-icd"
    return f"install your GPU's driver{cpu}"


def no_device() -> DeviceError:
    """The error that there is no device at all."""
    return DeviceError(f"no OpenCL device found: {driver_advice()}")
