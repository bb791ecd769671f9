# SPDX-License-Identifier: Apache-2.0
"""The cache of built programs: what is loaded computes the same, and what is damaged or of another machine is not
loaded."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from calls import refuses
from drivers import KEPT, label

from clsplat.device import context
from clsplat.device.buffers import allocate
from clsplat.device.context import Device, all_devices
from clsplat.device.drivers import binary_cache
from clsplat.device.drivers.quirks import wants_cache
from clsplat.device.launch import launch_groups
from clsplat.device.program import Kernels, Variant, build, variant_of
from clsplat.errors import DriverError

VARIANT = variant_of("probe", {"LANES": 4, "ITEMS": 1, "FMA_BY_CONTRACTION": True}, "-cl-std=CL1.2")


@pytest.fixture(params=KEPT, ids=label)
def fresh(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Device:
    """Each driver with an empty cache of ours, which it is said to want."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv(binary_cache.BINARIES_VARIABLE)
    monkeypatch.setattr(binary_cache, "wants_cache", lambda device: True)
    return Device(all_devices()[request.param])


def saved(device: Device, variant: Variant = VARIANT) -> Path:
    """Build and save the variant; its file."""
    build(device.context, device.cl_device, variant)
    (path,) = binary_cache.folder().iterdir()
    return path


def load(device: Device) -> Kernels | None:
    program = binary_cache.load(device.context, device.cl_device, VARIANT.digest, VARIANT.options)
    return None if program is None else Kernels(VARIANT, program)


def test_what_is_loaded_computes_the_same(fresh: Device) -> None:
    assert load(fresh) is None
    saved(fresh)
    kernels = load(fresh)
    assert kernels is not None
    built = Kernels(VARIANT, build(fresh.context, fresh.cl_device, VARIANT)[0])
    results = []
    for of in (built, kernels):
        out = allocate(fresh, (8,), np.float32)
        launch_groups(fresh, of.probe_fma, 1, 1, out, 1 + 2.0**-12, -(1 + 2.0**-11))
        results.append(out.get())
    np.testing.assert_array_equal(*results)


@pytest.mark.parametrize(
    ("stem", "shared"), [("ranges", True), ("density", True), ("sort_radix", False), ("blend", False), ("loss", False)]
)
def test_shapes_share_a_file_that_does_not_name_what_they_differ_in(
    stem: str, shared: bool, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def note(_context: object, _device: object, variant: Variant) -> None:
        asked.append(variant)
        raise DriverError("not built")

    monkeypatch.setattr(context, "build", note)
    for shape in ("1x32", "1x64"):
        refuses("not built", default_device.with_shape(shape)._built, stem, {}, error=DriverError)
    assert (asked[0].digest == asked[1].digest) is shared
    assert ("-DLANES=1" in asked[0].options) == (stem in {"density", "blend", "loss"})


@pytest.mark.parametrize("damage", ["empty", "cut", "changed"])
def test_a_damaged_file_is_built_anew(fresh: Device, damage: str) -> None:
    path = saved(fresh)
    content = bytearray(path.read_bytes())
    if damage == "empty":
        content.clear()
    elif damage == "cut":
        del content[len(content) // 2 :]
    else:
        content[-1] ^= 1
    path.write_bytes(content)
    assert load(fresh) is None
    assert saved(fresh) == path
    assert load(fresh) is not None


@pytest.mark.parametrize("other", ["target", "processor", "options"])
def test_another_machine_has_files_of_its_own(fresh: Device, monkeypatch: pytest.MonkeyPatch, other: str) -> None:
    saved(fresh)
    digest = VARIANT.digest
    if other == "target":
        monkeypatch.setenv("CL_CONFIG_CPU_TARGET_ARCH", "corei7")
    elif other == "processor":
        monkeypatch.setattr(binary_cache, "features", lambda: frozenset({"sse2"}))
    else:
        digest = Variant(VARIANT.stem, VARIANT.source, (*VARIANT.options, "-DMORE")).digest
    assert binary_cache.load(fresh.context, fresh.cl_device, digest, VARIANT.options) is None


def test_a_folder_that_takes_nothing_is_no_error(fresh: Device, tmp_path: Path) -> None:
    (tmp_path / "clsplat").write_text("a file")
    build(fresh.context, fresh.cl_device, VARIANT)
    assert load(fresh) is None


def test_a_folder_of_blanks_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    for blanks in ("", " "):
        monkeypatch.setenv(binary_cache.BINARIES_VARIABLE, blanks)
        assert binary_cache.folder().name == "binaries"


def test_the_oldest_files_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(binary_cache, "MAX_BINARY_CACHE_BYTES", 30)
    for age in range(5):
        path = tmp_path / f"{age:032x}.bin"
        path.write_bytes(bytes(10))
        os.utime(path, (1000 - age, 1000 - age))
    other = tmp_path / "a photo.bin"
    other.write_bytes(bytes(100))
    os.utime(other, (1, 1))
    binary_cache._make_room(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [*(f"{age:032x}.bin" for age in range(3)), other.name]


def test_only_a_driver_without_a_cache_gets_one() -> None:
    for device in all_devices():
        assert wants_cache(device) == ("intel" in device.vendor.lower() and "Intel" in device.platform.name)
