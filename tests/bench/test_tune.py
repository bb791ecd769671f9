# SPDX-License-Identifier: Apache-2.0
"""The shape of a device's kernels: by rule, by trial, by hand; and what was kept by a trial is found again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyopencl as cl
import pytest
from calls import Capture, no_warnings, printed, raising, refuses
from pipeline import shaped

from clsplat.bench import shapes as tune
from clsplat.cli.main import main
from clsplat.device.context import Device
from clsplat.device.drivers import shapes
from clsplat.device.drivers.shapes import (
    Shape,
    candidates,
    default_shape,
    most_items,
    save_shape,
    saved_path,
    saved_shapes,
    shape_of,
)
from clsplat.device.selection import list_devices
from clsplat.errors import DeviceError

A, B, C = Shape(8, 1, 8), Shape(16, 1, 8), Shape(4, 1, 8)


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("CLSPLAT_SHAPE", raising=False)


@pytest.mark.parametrize(
    ("ms", "wanted"),
    [
        ((10.0, 12.0, 11.0), A),
        ((10.0, 9.8, 11.0), A),  # within the noise
        ((10.0, 9.0, 8.0), C),
        ((None, 9.0, None), B),
        ((10.0, None, None), A),
        ((None, None, None), A),
    ],
)
def test_the_default_stays_unless_another_is_clearly_quicker(ms: tuple[float | None, ...], wanted: Shape) -> None:
    assert tune.choose([tune.Trial(shape, found) for shape, found in zip((A, B, C), ms, strict=True)]) == wanted


def test_candidates_begin_with_the_default(default_device: Device) -> None:
    found = candidates(default_device.cl_device)
    assert found[0] == default_shape(default_device.cl_device)
    assert len(set(found)) == len(found) > 1


def test_what_was_kept_is_found_again_and_forgotten(default_device: Device) -> None:
    device = default_device.cl_device
    other = replace(default_shape(device), lanes=4, items=2)
    save_shape(device, other)
    assert shape_of(device)[0] == other
    assert Device(device).shape == other, "also where no name was given, as in bench"
    assert any(info.shape == "4 lanes x 2 items" for info in list_devices())
    save_shape(device, None)
    assert shape_of(device)[0] == default_shape(device)


def test_the_environment_goes_first(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    device = default_device.cl_device
    save_shape(device, replace(default_shape(device), lanes=4))
    monkeypatch.setenv("CLSPLAT_SHAPE", "1x64")
    assert shape_of(device)[0] == replace(default_shape(device), lanes=1, items=64)


@pytest.mark.parametrize(
    "text", ["fast", "8", "3x1", "8x0", "8x3", "8x-1", "8x1g", "1x16g", "1x64gg", "8x1s", "1x16s", "1x64gs"]
)
def test_a_shape_that_makes_no_sense(text: str, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.setenv("CLSPLAT_SHAPE", text)
    assert f"CLSPLAT_SHAPE={text}: expected LANESxITEMS" in printed(capsys, ["devices"], status=2).err


def test_a_shape_that_is_too_large_for_the_device(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    device = default_device.cl_device
    save_shape(device, replace(default_shape(device), items=1 << 20))
    assert shape_of(device)[0] == default_shape(device)
    monkeypatch.setenv("CLSPLAT_SHAPE", "1x1048576")
    with pytest.raises(DeviceError, match=r"CLSPLAT_SHAPE=1x1048576: .* has at most [0-9]+ items in a work-group"):
        shape_of(device)


def test_a_gradient_by_gaussian_is_a_shape_of_its_own(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    device = default_device.cl_device
    walking = replace(default_shape(device), lanes=1, items=32, by_gaussian=True)
    save_shape(device, walking)
    assert shape_of(device)[0] == walking and walking.label == "1x32g"
    assert walking.words == "1 lanes x 32 items, by Gaussian"
    assert default_device.with_shape("1x32g").with_shape().shape == walking
    assert not default_device.with_shape("1x32g").with_shape(items=64).shape.by_gaussian
    monkeypatch.setenv("CLSPLAT_SHAPE", "1x64")
    assert shape_of(device)[0].label == "1x64"
    labels = [shape.label for shape in candidates(gpu(1024, 48))]
    assert labels == ["1x64", "1x32", "1x128", "1x256", "1x32g", "1x64g"]
    assert [shape.label for shape in candidates(gpu(32, 48))] == ["1x32", "1x32g"]


def test_a_shape_with_sub_groups(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is a candidate where a device has some; where it has none, a tuned one is passed over and one that was asked
    for is an error."""
    device = default_device.cl_device
    some = replace(default_shape(device), lanes=1, items=64, subgroups=True)
    save_shape(device, some)
    monkeypatch.setattr(shapes, "subgroup_ways", lambda device: [{"SUBGROUP": 8}])
    assert shape_of(device)[0] == some and (some.label, some.words) == ("1x64s", "1 lanes x 64 items, with sub-groups")
    assert not default_device.with_shape("1x64s").with_shape(items=32).shape.subgroups
    labels = [shape.label for shape in candidates(gpu(1024, 48))]
    assert labels == ["1x64", "1x32", "1x128", "1x256", "1x32g", "1x64g", "1x32s", "1x64s"]
    monkeypatch.setattr(shapes, "subgroup_ways", lambda device: [])
    assert shape_of(device)[0] == default_shape(device)
    monkeypatch.setenv("CLSPLAT_SHAPE", "1x128s")
    message = "CLSPLAT_SHAPE=1x128s: .* has no sub-groups .* expected a shape without the s, such as 1x128$"
    refuses(message, shape_of, device, error=DeviceError)


def gpu(items: int, local_kib: int) -> Any:
    """A device that is none, with these limits."""
    platform = SimpleNamespace(name="none", version="OpenCL 1.2 none")
    return SimpleNamespace(
        type=cl.device_type.GPU, max_work_group_size=items, local_mem_size=local_kib << 10, max_compute_units=4,
        name="a GPU", driver_version="1", version="OpenCL 1.2", platform=platform, native_vector_width_float=1,
        single_fp_config=0, max_mem_alloc_size=1 << 28, extensions="",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("items", "local_kib", "most"), [(1024, 32, 1024), (1024, 48, 1024), (1024, 16, 128), (256, 64, 256), (1, 32, 1)]
)
def test_items_that_fit_local_memory(items: int, local_kib: int, most: int) -> None:
    device = gpu(items, local_kib)
    assert most_items(device) == most
    assert default_shape(device).items == min(most, 64)
    assert all(shape.items <= most for shape in candidates(device))
    if most > 1:
        assert replace(default_shape(device), items=most).local_bytes <= max(local_kib, 32) << 10


def test_a_shape_that_local_memory_is_too_small_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sort of 256 items or more takes 26.75 KiB, which is less than the 32 that OpenCL promises."""
    device = gpu(1024, 16)
    monkeypatch.setenv("CLSPLAT_SHAPE", "1x256")
    with pytest.raises(
        DeviceError, match="has 16 KiB of local memory, and a group of 256 items needs 26 KiB; expected"
    ):
        shape_of(device)
    monkeypatch.setenv("CLSPLAT_SHAPE", "1x128")
    assert shape_of(device)[0].items == 128
    monkeypatch.setenv("CLSPLAT_SHAPE", "1x1024")
    assert shape_of(gpu(1024, 32))[0].items == 1024


@pytest.mark.parametrize("content", ["no JSON", "[]", '{"a": 1}', pytest.param("[" * 100_000, id="deep")])
def test_a_broken_file_is_passed_over(content: str, default_device: Device) -> None:
    saved_path().parent.mkdir(parents=True)
    saved_path().write_text(content)
    with pytest.warns(UserWarning, match=r"shapes\.json: the file is damaged, so no tuned shape is used"):
        assert shape_of(default_device.cl_device)[0] == default_shape(default_device.cl_device)
    save_shape(default_device.cl_device, replace(default_shape(default_device.cl_device), lanes=4))
    assert list(saved_shapes().values()) == ["4x1"], "it is written anew"


def test_a_home_that_is_no_folder_or_cannot_be_read(
    default_device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = default_device.cl_device
    (tmp_path / "file").touch()
    with no_warnings():
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
        assert shape_of(device)[0] == default_shape(device)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    saved_path().mkdir(parents=True)  # what cannot be read by root either
    with pytest.warns(UserWarning, match=r"shapes\.json: cannot be read \(it is a folder\)"):
        assert shape_of(device)[0] == default_shape(device)


def test_a_user_without_a_home(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", raising(RuntimeError("Could not determine home directory.")))
    device = default_device.cl_device
    assert shape_of(device)[0] == default_shape(device)
    with pytest.raises(OSError):  # tune says that it cannot keep what it found
        save_shape(device, default_shape(device))


@pytest.mark.slow
def test_measure_in_several_shapes(default_device: Device) -> None:
    for shape in ((8, 1), (1, 64)):
        assert tune.measure(shaped(default_device, *shape), (300, 70, 50), repeat=1) > 0


def test_a_candidate_that_fails(default_device: Device) -> None:
    index = next(info.index for info in list_devices() if info.version == default_device.driver)
    assert tune._in_a_process(index, Shape(3, 1, 8)) is None


def test_the_verb(default_device: Device, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    device = default_device.cl_device
    chosen = candidates(device)[1]
    monkeypatch.setattr(tune, "_in_a_process", lambda _index, shape: 5.0 if shape == chosen else 7.0)
    name = str(next(info.index for info in list_devices() if info.version == default_device.driver))
    result = json.loads(printed(capsys, ["tune", "--device", name, "--json"]).out)
    assert (result["best"]["lanes"], result["best"]["items"]) == (chosen.lanes, chosen.items)
    assert shape_of(device)[0] == chosen
    assert "5.00 ms  <- saved" in printed(capsys, ["tune", "--device", name]).out
    assert main(["tune", "--device", name, "--forget"]) == 0
    assert shape_of(device)[0] == default_shape(device)


def test_no_such_device(capsys: Capture) -> None:
    assert "abacus" in printed(capsys, ["tune", "--device", "abacus"], status=2).err


def test_device_error_is_of_input(monkeypatch: pytest.MonkeyPatch, default_device: Device) -> None:
    monkeypatch.setenv("CLSPLAT_SHAPE", "x")
    with pytest.raises(DeviceError):
        shape_of(default_device.cl_device)
