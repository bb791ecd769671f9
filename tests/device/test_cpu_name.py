# SPDX-License-Identifier: Apache-2.0
"""PoCL 3.0 builds on processors that its compiler does not know."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

import pytest
from calls import python

from clsplat.device.context import all_devices
from clsplat.device.drivers import cpu_name
from clsplat.device.drivers.cpu_name import CPU_NAMES_BY_FEATURES, better_name, features, name_processor
from clsplat.errors import KernelBuildError

ZEN2 = frozenset({"sse2", "avx", "popcnt", "aes", "pclmulqdq", "avx2", "fma", "bmi1", "bmi2", "f16c", "movbe", "abm"})
ZEN5 = ZEN2 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}


@pytest.mark.parametrize(
    ("name", "has", "wanted"),
    [
        ("generic", ZEN5, "skylake-avx512"),
        ("generic", ZEN5 - {"avx512vl"}, "haswell"),
        ("generic", ZEN2, "haswell"),
        ("generic", frozenset({"sse2"}), "x86-64"),
        ("znver3", ZEN5, "skylake-avx512"),
        ("znver3", ZEN2, "znver3"),
        ("icelake-server", ZEN5, "icelake-server"),
        ("generic", frozenset(), "generic"),  # nothing is known of the processor: better an error than its crash
    ],
)
def test_names(name: str, has: frozenset[str], wanted: str) -> None:
    assert better_name(name, has) == wanted


def test_features_of_a_file(tmp_path: Path) -> None:
    file = tmp_path / "cpuinfo"
    assert features(tmp_path / "none") == frozenset()
    file.write_text("processor\t: 0\nflags\t\t: fpu sse2 avx\nbugs\t: none\nflags\t: other\n")
    assert features(file) == {"fpu", "sse2", "avx"}


def pocl_3() -> list[int]:
    return [i for i, device in enumerate(all_devices()) if "OpenCL 3.0 PoCL 3.0" in device.platform.version]


CHILD = """
import ctypes, os, sys
from clsplat.device import context, selection
from clsplat.device.drivers import cpu_name
device = context.all_devices()[int(sys.argv[1])]
place = cpu_name._place(device.int_ptr)
text = ctypes.create_string_buffer(sys.argv[2].encode())
ctypes.c_void_p.from_address(place).value = ctypes.addressof(text)
if sys.argv[3] == "mended":
    cpu_name.name_processor(device)
else:
    context.name_processor = lambda device: ""
opened = selection.open_device(sys.argv[1])
opened.kernels("probe", {"FMA_BY_CONTRACTION": True})
"""


@pytest.mark.parametrize("mended", [True, False])
def test_a_processor_that_llvm_does_not_know(mended: bool, tmp_path: Path) -> None:
    """In a child with a cache of its own: PoCL would take what it built under another name."""
    if not pocl_3():
        pytest.skip("PoCL 3.0 is not there")
    words = (pocl_3()[0], "generic", "mended" if mended else "left")
    child = python("-c", CHILD, *words, env={**os.environ, "POCL_CACHE_DIR": str(tmp_path)})
    assert (child.returncode == 0) == mended, child.stderr
    if not mended:
        assert KernelBuildError.__name__ in child.stderr
        assert "this driver is older than the processor: use another driver" in child.stderr


def test_other_drivers_are_left_alone() -> None:
    for index, device in enumerate(all_devices()):
        name = name_processor(device)
        assert (name != "") == (index in pocl_3())
        assert name != "generic"


def test_a_record_without_the_name_is_left_alone() -> None:
    record = (ctypes.c_uint64 * (cpu_name.DEVICE_RECORD_BYTES // 8 + 1))(
        *range(0, 8 * (cpu_name.DEVICE_RECORD_BYTES // 8 + 1), 8)
    )
    assert cpu_name._place(ctypes.addressof(record)) is None
    triple, name = (ctypes.create_string_buffer(text) for text in (b"x86_64-unknown-linux-gnu", b"znver2"))
    record[9], record[10] = ctypes.addressof(triple), ctypes.addressof(name)
    assert cpu_name._place(ctypes.addressof(record)) == ctypes.addressof(record) + 80
    record[10] = 1
    assert cpu_name._place(ctypes.addressof(record)) is None


def test_the_least_processor_is_any() -> None:
    assert CPU_NAMES_BY_FEATURES[-1][1] == set()
