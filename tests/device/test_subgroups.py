# SPDX-License-Identifier: Apache-2.0
"""Sub-groups: which a device offers, and what is said where they do not do what they should."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from calls import refuses

from clsplat.device import context
from clsplat.device.context import Device
from clsplat.device.drivers.quirks import subgroup_ways
from clsplat.errors import DeviceError


def offering(*extensions: str) -> Any:
    """A device that is none, with these extensions."""
    return SimpleNamespace(extensions=" ".join(extensions))


SIZED = "cl_intel_required_subgroup_size"


@pytest.mark.parametrize(
    ("extensions", "shuffles", "sizes"),
    [
        ((), [], []),
        (("cl_khr_fp64", "cl_khr_subgroups"), [], []),
        (("cl_khr_subgroup_shuffle", "cl_intel_subgroups"), [], []),  # of a size that is not known
        (("cl_nv_device_attribute_query",), ["SHUFFLE_PTX"], [32]),
        (("cl_amd_device_attribute_query", "cl_khr_subgroups"), ["SHUFFLE_AMD"], [32]),
        (("cl_intel_subgroups", SIZED), ["SHUFFLE_INTEL"] * 3, [16, 32, 8]),
        (("cl_khr_subgroup_shuffle", "cl_intel_subgroups", SIZED),
         ["SHUFFLE_KHR"] * 3 + ["SHUFFLE_INTEL"] * 3, [16, 32, 8] * 2),
    ],
)  # fmt: skip
def test_ways_by_extensions(extensions: tuple[str, ...], shuffles: list[str], sizes: list[int]) -> None:
    found = subgroup_ways(offering(*extensions))
    assert [way["SUBGROUP"] for way in found] == sizes
    assert [name for way in found for name in way if name.startswith("SHUFFLE")] == shuffles
    assert all(way.get("SUBGROUP_IS_ASKED", False) == (SIZED in extensions) for way in found)


def with_ways(device: Device) -> Device:
    """The device in a shape with sub-groups. Skips the test where it has none."""
    if not subgroup_ways(device.cl_device):
        pytest.skip("the driver has no sub-groups of a size that is known")
    return device.with_shape("1x64s")


@pytest.mark.parametrize("wrong", [{}, {"EXCHANGED(x,step)": "(x)"}], ids=["does not build", "exchanges nothing"])
def test_the_next_way_is_taken(device: Device, wrong: dict[str, object], monkeypatch: pytest.MonkeyPatch) -> None:
    """A way that a driver's compiler refuses, or that does not do what it should, is passed over."""
    opened, (_, second, *_) = with_ways(device), subgroup_ways(device.cl_device)
    monkeypatch.setattr(context, "subgroup_ways", lambda device: [{"SUBGROUP": 8, **wrong}, second])
    options = opened.kernels("blend_grad").blend_grad.variant.options
    assert {f"-DSUBGROUP={second['SUBGROUP']}", "-DSUBGROUP_IS_ASKED"} <= set(options)


def test_none_of_the_ways_works(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """The error names the device, and the shape that would do."""
    opened = with_ways(device)
    monkeypatch.setattr(context, "subgroup_ways", lambda device: [{"SUBGROUP": 8, "EXCHANGED(x,step)": "(x)"}])
    message = r"the work-items of a sub-group got wrong values from each other; .* such as CLSPLAT_SHAPE=1x64$"
    refuses(message, opened.kernels, "blend_grad", error=DeviceError)
    assert opened.kernels("blend"), "other kernels have no sub-groups"
