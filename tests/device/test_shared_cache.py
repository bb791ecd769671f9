# SPDX-License-Identifier: Apache-2.0
"""A driver's cache of kernels that other processes use at the same time, and signals while it is filled.

`tools/stress/run cache` starts forty processes at once on an empty one.
"""

from __future__ import annotations

import sys

import pyopencl as cl
import pytest
from calls import python, refuses
from drivers import KEPT

from clsplat.device import program
from clsplat.device.context import Device
from clsplat.device.program import Variant, build, variant_of
from clsplat.errors import DriverError, KernelBuildError

TEXT = "kernel void {name}(global float *out) {{ out[0] = 1.0f; }}\n"


@pytest.fixture(autouse=True)
def no_binaries(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(program.binary_cache, "load", lambda *_: None)
    monkeypatch.setattr(program.binary_cache, "save", lambda *_: None)


def contended(monkeypatch: pytest.MonkeyPatch, failures: list[str]) -> list[str]:
    """Have the first builds fail, one for each of `failures`: error, as where another process has taken a file away, or
    empty, as of what an aborted build left. Returns the texts that are built."""
    texts: list[str] = []
    real = cl.Program.build

    def once(self: cl.Program, *arguments: object, **more: object) -> cl.Program:
        texts.append(str(self._source))
        how = failures[len(texts) - 1] if len(texts) <= len(failures) else ""
        if how == "error":
            raise cl.RuntimeError("unable to rename temporary 't-1f.tmp' to output file 't.preproc.cl'")
        if how == "empty":
            return real(cl.Program(self._context, "typedef int nothing;"), *arguments, **more)
        return real(self, *arguments, **more)

    monkeypatch.setattr(cl.Program, "build", once)
    return texts


@pytest.mark.parametrize("failure", ["error", "empty"])
@pytest.mark.parametrize("stem", ["scan", "ranges"])
def test_a_build_that_another_process_disturbs_is_made_anew(
    failure: str, stem: str, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    variant = variant_of(stem, {"ITEMS": 1, "LANES": 1}, "-cl-std=CL1.2")
    texts = contended(monkeypatch, [failure])
    built, salt = build(default_device.context, default_device.cl_device, variant)
    assert built.num_kernels > 0
    assert len(salt) == 16  # 8 random bytes: no other process has this text
    assert texts == [variant.source, variant.anew(salt).source]


def test_a_quiet_build_is_made_once_in_its_own_text(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    texts = contended(monkeypatch, [])
    variant = Variant("one", TEXT.format(name="one"), ("-cl-std=CL1.2",))
    assert build(default_device.context, default_device.cl_device, variant)[1] == ""
    assert texts == [variant.source]


@pytest.mark.parametrize(
    ("failures", "error", "words"),
    [
        (["error", "error"], KernelBuildError, "unable to rename"),
        (["empty", "error"], KernelBuildError, "unable to rename"),
        (["error", "empty"], DriverError, "has no kernels"),
        (["empty", "empty"], DriverError, "has no kernels"),
    ],
)
def test_what_fails_twice_is_an_error(
    failures: list[str], error: type[Exception], words: str, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts = contended(monkeypatch, failures)
    variant = Variant("two", TEXT.format(name="two"), ("-cl-std=CL1.2",))
    refuses(words, build, default_device.context, default_device.cl_device, variant, error=error)
    assert len(texts) == 2


MASKS = """
import os, signal, sys, threading
{before}
from clsplat.device.selection import open_device
thread = threading.Thread(target=open_device, args=({index!r},))
thread.start() if {aside} else open_device({index!r})
thread.join() if {aside} else None
print(len(signal.pthread_sigmask(signal.SIG_BLOCK, [])))
for task in os.listdir("/proc/self/task"):
    try:
        with open(f"/proc/self/task/{{task}}/status") as file:
            blocked = next(int(line.split()[1], 16) for line in file if line.startswith("SigBlk"))
    except FileNotFoundError:  # a thread that has just ended
        continue
    if int(task) not in (os.getpid(), thread.native_id):  # which may not have gone yet
        print(*(number in (1, 2, 15) and blocked >> number - 1 & 1 for number in (1, 2, 15)))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="threads are listed in /proc")
@pytest.mark.parametrize("aside", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("ignored", ["", "signal.signal(signal.SIGHUP, signal.SIG_IGN)"])
@pytest.mark.parametrize("index", [index for index, info in KEPT.items() if "PoCL" in info.version])
def test_a_drivers_threads_have_no_signals(index: int, ignored: str, aside: bool) -> None:
    """Their linkers inherit that: a Ctrl-C would else end one in the middle, and PoCL aborts then."""
    code = MASKS.format(index=str(index), before=ignored, aside=aside)
    done = python("-c", code, timeout=120)
    assert done.returncode == 0, done.stderr
    first, *threads = done.stdout.splitlines()
    assert first == "0"  # the main thread has all signals
    # SIGHUP, SIGINT, SIGTERM; what is ignored stays so in programs too
    assert set(threads) == {"0 1 1" if ignored else "1 1 1"}
