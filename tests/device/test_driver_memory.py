# SPDX-License-Identifier: Apache-2.0
"""What is remembered of drivers, told of them and forgotten; trials that cannot be made, and that are asked to end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from calls import Capture, printed, refuses, warned
from dying import ALWAYS, DRIVER, Standing

from clsplat.cli.main import main
from clsplat.device import context, launch, selection
from clsplat.device.buffers import allocate
from clsplat.device.context import Device
from clsplat.device.drivers import driver_records, shapes, worker_process
from clsplat.device.program import Kernels, Variant, build
from clsplat.errors import DeviceError, DriverError
from clsplat.files.locks import briefly_locked
from clsplat.selftest import driver_check
from clsplat.selftest.driver_check import DriverReport
from clsplat.selftest.result import SELFTEST_STAGES

POSIX = pytest.mark.skipif(os.name == "nt", reason="signals are sent as POSIX has it")


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of its own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    driver_records.tell_once.cache_clear()
    return tmp_path / "cache"


REMEMBER = """
import sys
from clsplat.device.drivers import driver_records
from clsplat.device.context import all_devices
for number in range(25):
    driver_records.remember(all_devices()[0], "8x1", kernels={f"{sys.argv[1]} {number}": ""})
"""


@pytest.mark.slow
def test_processes_that_remember_at_once(elsewhere: Path) -> None:
    words = [[sys.executable, "-c", REMEMBER, name] for name in "ab"]
    begun = [subprocess.Popen(each) for each in words]
    assert [each.wait(timeout=60) for each in begun] == [0, 0]
    found = driver_records.entries(context.all_devices()[0])["8x1"].kernels
    assert set(found) == {f"{name} {number}" for name in "ab" for number in range(25)}


def test_a_lock_is_waited_for_and_not_for_ever(tmp_path: Path) -> None:
    path = tmp_path / "words.json"
    order = []

    def later() -> None:
        with briefly_locked(path):
            order.append("second")

    other = threading.Thread(target=later)
    with briefly_locked(path):
        other.start()
        time.sleep(0.1)
        order.append("first")
    other.join()
    assert order == ["first", "second"]
    assert not list(tmp_path.iterdir())
    (tmp_path / "words.json.lock").write_bytes(b"of one that was killed")
    os.utime(tmp_path / "words.json.lock", (0, 0))
    with briefly_locked(path):
        assert (tmp_path / "words.json.lock").read_bytes() != b"of one that was killed"
    with briefly_locked(path):  # held for longer than anybody waits
        begun = time.monotonic()
        with briefly_locked(path, seconds=0.2):
            assert time.monotonic() - begun < 10


def test_what_could_not_be_written_is_written_later(elsewhere: Path) -> None:
    device = context.all_devices()[0]
    elsewhere.write_text("a file where the folder would be")
    warned("cannot be written", driver_records.remember, device, "8x1", kernels={"first": ""})
    driver_records.remember(device, "8x1", kernels={"second": ""})  # told once
    assert set(driver_records.entries(device)["8x1"].kernels) == {"first", "second"}
    elsewhere.unlink()
    driver_records.remember(device, "8x1", kernels={"third": ""})
    shapes_of = json.loads(driver_records.memory_path().read_bytes())[driver_records.driver_key(device)]
    assert set(shapes_of["8x1"]["kernels"]) == {"first", "second", "third"}
    driver_records.memory_path().unlink()
    assert not driver_records.entries(device)


def test_a_shape_that_one_device_cannot_take(elsewhere: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.setenv("CLSPLAT_SHAPE", "1x1024")
    small = context.all_devices()[0]
    monkeypatch.setattr(shapes, "most_items", lambda device: 256 if device == small else 4096)
    told = {each["index"]: each["shape"] for each in json.loads(printed(capsys, ["devices", "--json"]).out)}
    assert told.pop(0) == "cannot take CLSPLAT_SHAPE=1x1024"
    assert set(told.values()) <= {"1 lanes x 1024 items"}
    refuses(r"CLSPLAT_SHAPE=1x1024: .* expected at most 256 items", selection.open_device, "0", error=DeviceError)
    monkeypatch.setenv("CLSPLAT_SHAPE", "wide")
    assert "expected LANESxITEMS" in printed(capsys, ["devices"], status=2).err


def test_only_what_is_used_warns_and_names_what_is_taken(
    standing: Standing, standing_device: Device, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    standing("abort", ALWAYS)
    device = standing_device.cl_device
    first, second, third = shapes.shapes_in_turn(device)[:3]
    driver_records.remember(device, first.label, failed="it failed")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert main(["devices"]) == 0
        opened = selection.open_device()
    assert "warning" not in capsys.readouterr().err
    assert opened.shape == second
    warned(f"shape {first.label} failed: it failed; {second.label} is used instead", opened.kernels, "scan")
    driver_records.tell_once.cache_clear()
    monkeypatch.setattr(driver_check, "_short_test", lambda tried, _: "as well" if tried.shape == second else "")
    with pytest.warns(UserWarning, match=f"shape {first.label} failed: it failed; {third.label} is used") as told:
        driver_check.require(selection.open_device()).kernels("scan")
    assert sum("is used instead" in str(each.message) for each in told) == 1


@pytest.mark.slow
def test_a_failure_is_forgotten_when_what_failed_works(
    standing: Standing, standing_device: Device, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    """The self-test does not come by every variant of every kernel."""
    device, label, index = standing_device.cl_device, standing_device.shape.label, DRIVER
    standing("abort", 1)
    with pytest.raises(DriverError):
        selection.open_device().kernels("scan")
    failed = driver_records.entries(device)[label].failed
    assert "probe.cl" in failed
    monkeypatch.setattr(driver_check, "examine", lambda *_: DriverReport())
    assert main(["selftest", "--device", str(index)]) == 0
    assert f"The kernel shape that failed stays disabled: {failed}; tried once more: " in capsys.readouterr().out
    assert driver_records.entries(device)[label].failed == failed
    standing("abort", ALWAYS)
    assert json.loads(printed(capsys, ["selftest", "--device", index, "--json"]).out)[0]["remembered"] == ""
    assert driver_records.entries(device)[label].failed == ""


@pytest.mark.parametrize(
    ("trial", "kernels", "left"),
    [
        ({}, {}, ""),
        ({"name": "0123 scan"}, {"0123 scan": ""}, ""),
        ({"name": "0123 scan"}, {"0123": ""}, "it failed; this test does not use that kernel"),
    ],
    ids=["a stage", "a kernel of the test", "another kernel"],
)
def test_what_is_left_of_a_failure(trial: dict[str, str], kernels: dict[str, str], left: str) -> None:
    assert (
        driver_check._still(0, driver_records.Entry(failed="it failed", trial=trial), DriverReport(kernels=kernels))
        == left
    )


@pytest.mark.slow
@pytest.mark.parametrize("python", [None, "", "missing"])
def test_a_python_that_cannot_be_started(
    python: str | None, standing: Standing, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    """As in a program that has Python built in."""
    standing("abort", ALWAYS)
    monkeypatch.setattr(sys, "executable", str(tmp_path / python) if python else python)
    assert main(["bench", "--gaussians", "300", "--size", "64x48", "--repeat", "1"]) == 1
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert line.endswith("CLSPLAT_TRUST_DRIVER=1 skips the trial")
    refuses("CLSPLAT_TRUST_DRIVER=1", selection.open_device().kernels, "scan", error=DriverError)


@POSIX
def test_a_trial_ends_at_once_when_the_process_is_asked_to(standing: Standing) -> None:
    """Also where the handler only takes note, as that of a training."""
    standing("hang", 1)
    noted = []
    before = signal.signal(signal.SIGINT, lambda *_: noted.append(True))
    try:
        kernels = selection.open_device().kernels
        timer = threading.Timer(1.0, lambda: os.kill(os.getpid(), signal.SIGINT))
        timer.start()
        begun = time.monotonic()
        with pytest.raises(worker_process.TrialInterrupted):
            kernels("scan")
        assert time.monotonic() - begun < 20
        assert noted == [True]
        os.kill(os.getpid(), signal.SIGINT)
        assert noted == [True, True]
    finally:
        signal.signal(signal.SIGINT, before)


def test_other_threads_do_not_wait_for_a_trial_either(standing: Standing) -> None:
    standing("hang", 1)
    device, ends = selection.open_device(), []

    def work() -> None:
        try:
            device.kernels("scan")
        except worker_process.TrialInterrupted as error:
            ends.append(type(error))

    thread = threading.Thread(target=work)
    thread.start()
    while not worker_process._alive:
        time.sleep(0.01)
    time.sleep(0.5)
    begun = time.monotonic()
    worker_process.abandon()  # as at the end of this process, which does not wait for the trial either
    assert time.monotonic() - begun < 10
    thread.join(timeout=20)
    assert ends == [worker_process.TrialInterrupted]


INTERRUPTED = {
    "train": "train {scene} -o {new} --iterations 3",
    "render": "render {run} --cameras {scene} -o {new}/####.exr",
    "view": "view {run} --port 0",
}


@POSIX
@pytest.mark.slow
@pytest.mark.parametrize("verb", INTERRUPTED)
def test_ctrl_c_while_a_driver_hangs(
    verb: str, standing: Standing, scene: Path, trained: Path, tmp_path: Path, standing_device: Device
) -> None:
    if verb == "view":
        pytest.importorskip("viser")
    numbers = standing("hang", 1)
    driver_records.remember(standing_device.cl_device, standing_device.shape.label, stages=SELFTEST_STAGES)
    words = INTERRUPTED[verb].format(scene=scene, run=trained, new=tmp_path / "new").split()
    process = subprocess.Popen([sys.executable, "-m", "clsplat", *words], stderr=subprocess.PIPE, text=True)
    while not numbers.exists() and process.poll() is None:
        time.sleep(0.1)
    time.sleep(0.5)
    begun = time.monotonic()
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert time.monotonic() - begun < 15
    assert process.returncode == 130, said
    assert "Traceback" not in said
    assert "clsplat: interrupted" in said.splitlines()[-1]


TEXT = "__kernel void fill(__global uint *out) { out[get_global_id(0)] = 1; }"


def test_what_a_driver_compiles_anew_is_tried_anew(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """PoCL has other code from 65,536 items on, and for groups of a size that it chooses; a width is no reason."""
    device = default_device
    variant = Variant("fill", TEXT, ("-cl-std=CL1.2",))
    kernel = Kernels(variant, build(device.context, device.cl_device, variant)[0]).fill
    tried: list[str] = []
    monkeypatch.setattr(device.trials, "launch", lambda *given: tried.append(given[-1]))
    monkeypatch.setattr(device, "compiles_by_size", True)
    out = allocate(device, (1 << 17,), np.uint32)
    for groups, items in ((1, 64), (2, 64), (2, 32), (1 << 10, 64), (1 << 11, 32), (3, 16)):
        launch.launch_groups(device, kernel, groups, items, out)
    assert tried == ["", " of many items"]
    launch.launch_grid(device, kernel, (2048, 2), out)
    assert tried[2:] == [" of any groups"]
    kernel.tried.clear()
    monkeypatch.setattr(device, "compiles_by_size", False)
    launch.launch_groups(device, kernel, 1, 64, out)
    launch.launch_groups(device, kernel, 1 << 10, 64, out)
    assert tried[3:] == [""]
    with launch.only_tried(device):
        out.fill(0)
        launch.launch_groups(device, kernel, 1, 64, out)
        assert not out.get().any()
