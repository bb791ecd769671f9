# SPDX-License-Identifier: Apache-2.0
"""The table of machines: how its rows are made, and that one that fails or hangs is found."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import calls
import pytest
from calls import Capture, ran, refuses

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.skipif(os.name == "nt", reason="tools/ci/machines.py is for systems with process groups")
if os.name != "nt":
    import machines
    from machine_runs import Machine, Step, environment_of, run_all, run_machine, table, wrong
    from machines import Found

ALL = {
    "pypi": True,
    "intel": "/i.so",
    "debian": "/d.so",
    "rusticl": "/r.so",
    "qemu": "/qemu",
    "avx512": True,
    "root": True,
    "mounts": ("unshare",),
    "stranger": ("setpriv",),
}


def rows(**changes: object) -> dict[str, Machine]:
    found = {**ALL, **changes}
    return {row.name: row for row in machines.machines(Found(**found))}  # type: ignore[arg-type]


def python(code: str, **settings: object) -> Step:
    return Step("it", (sys.executable, "-c", code), **{"limit": 60, **settings})  # type: ignore[arg-type]


def test_each_machine_has_its_own_drivers(tmp_path: Path) -> None:
    made = rows()
    assert not [row.name for row in made.values() if row.missing]
    assert len(made) == 19
    drivers = {name: ({key for key, _ in row.drivers}, row.pypi) for name, row in made.items()}
    assert drivers["pypi-pocl"] == (set(), True)
    assert drivers["intel-skx"] == ({"intel"}, False)
    assert drivers["debian-pocl-sse2"] == ({"debian"}, False)
    assert drivers["rusticl"] == ({"rusticl"}, False)
    assert drivers["none"] == (set(), False)
    assert drivers["all"] == ({"debian", "intel", "rusticl"}, True)
    assert environment_of(made["debian-pocl-avx2"], tmp_path)["POCL_KERNELLIB_NAME"] == "avx2"
    assert environment_of(made["intel-corei7"], tmp_path)["CL_CONFIG_CPU_TARGET_ARCH"] == "corei7"
    assert environment_of(made["pypi-pocl-1-thread"], tmp_path)["POCL_MAX_PTHREAD_COUNT"] == "1"
    assert environment_of(made["pypi-pocl-haswell"], tmp_path)["CLSPLAT_INTERPRETER"] == str(tmp_path / "python")


def test_a_short_table_has_no_driver_twice_and_few_smoke_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[Machine] = []

    def run(rows: list[Machine], **_: object) -> int:
        ran.extend(rows)
        return 0

    monkeypatch.setattr(machines, "look", lambda: Found(**ALL))  # type: ignore[arg-type]
    monkeypatch.setattr(machines, "run_all", run)
    assert machines.main(["--short"]) == 0
    steps = {row.name: [step.name for step in row.steps] for row in ran}
    assert steps.keys() == rows().keys() - set(machines.IN_ALL)
    assert {name for name, names in steps.items() if machines.SMOKE in names} == set(machines.SHORT_SMOKE)
    assert steps["intel-core-avx2"] == steps["all"] == ["short self-test"]
    smoke = [step.command for row in ran for step in row.steps if step.name == machines.SMOKE]
    assert not [word for command in smoke for word in command if word.startswith("tests/stages/")]
    assert steps["ascii"] == ["short self-test", "scene", "ten steps"]
    every = rows()
    for name in machines.IN_ALL:
        drivers = every[name].drivers
        assert set(drivers) <= set(every["all"].drivers) and every["all"].pypi
        assert [row for row in ran if row.drivers == drivers], f"none has the drivers of {name} alone"
    ran.clear()
    assert machines.main(["--short", "--only", "intel"]) == 0
    assert [row.name for row in ran] == ["intel"]


def test_nothing_of_ours_gets_into_a_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CLSPLAT_TRUST_DRIVER", "1")
    monkeypatch.setenv("OCL_ICD_VENDORS", "/ours")
    environment = environment_of(rows()["pypi-pocl"], tmp_path)
    assert "CLSPLAT_TRUST_DRIVER" not in environment
    assert environment["OCL_ICD_VENDORS"] == str(tmp_path / "drivers")
    assert environment["HOME"] == str(tmp_path / "home")


def test_only_machines_with_other_texts_load_built_kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = machines.BUILT_KERNELS
    monkeypatch.setenv(name, "/built")
    folders = {key: environment_of(row, tmp_path).get(name) for key, row in rows().items()}
    assert {key: folder for key, folder in folders.items() if folder} == {"lang-c": "/built", "ascii": "/built"}
    monkeypatch.delenv(name)
    assert not [key for key, row in rows().items() if name in environment_of(row, tmp_path)]


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"intel": ""}, ["intel", "intel-corei7", "intel-core-avx2", "intel-skx"]),
        ({"debian": ""}, ["debian-pocl", "debian-pocl-sse2", "debian-pocl-avx2"]),
        ({"rusticl": ""}, ["rusticl"]),
        ({"avx512": False}, ["intel-skx"]),
        ({"qemu": ""}, ["pypi-pocl-haswell"]),
        ({"mounts": ()}, ["full-tmp"]),
        ({"stranger": ()}, ["not-root"]),
    ],
)
def test_what_cannot_be_had_is_not_run_and_says_why(changes: dict[str, object], names: list[str]) -> None:
    made = rows(**changes)
    assert [row.name for row in made.values() if row.missing] == names
    result = run_machine(made[names[0]])
    assert result.words == f"not run: {made[names[0]].missing}"
    assert run_all([made[names[0]]]) == 0


def test_a_home_is_read_only_without_mounts_too(tmp_path: Path) -> None:
    row = rows(mounts=())["read-only-home"]
    row.prepare(tmp_path)
    refuses("Not a directory", Path(environment_of(row, tmp_path)["HOME"]).mkdir, parents=True, error=OSError)


def test_one_that_fails_fails_the_run_and_the_others_are_run(capsys: Capture) -> None:
    good = Machine("good", "passes", (python("print('fine')"),))
    bad = Machine("bad", "fails", (python("import sys; sys.exit('the trouble')"), python("print('never')")))
    assert "1 passed, 0 failed, 0 not run" in ran(capsys, run_all, [good]).out
    printed = ran(capsys, run_all, [bad, good], jobs=2, status=1).out
    assert "bad: FAILED: it: exit status 1, expected 0\n    the trouble\n" in printed
    assert "1 passed, 1 failed, 0 not run" in printed
    assert "never" not in printed


@pytest.mark.slow
def test_one_that_hangs_is_ended_with_its_children(tmp_path: Path) -> None:
    here = tmp_path / "child"
    child = f"import pathlib, time; time.sleep(4); pathlib.Path({str(here)!r}).touch()"
    code = f"import subprocess, sys, time; subprocess.Popen([sys.executable, '-c', {child!r}]); time.sleep(600)"
    start = time.monotonic()
    result = run_machine(Machine("hung", "hangs", (python(code, limit=2),)))
    assert result.trouble == "it: did not end within 2 s"
    assert time.monotonic() - start < 60
    time.sleep(4)
    assert not here.exists()


def test_ctrl_c_ends_what_runs(tmp_path: Path) -> None:
    begun = tmp_path / "begun"
    code = f"import pathlib, time; pathlib.Path({str(begun)!r}).touch(); time.sleep(600)"
    script = (
        f"import sys; sys.path.insert(0, {str(ROOT / 'tools/ci')!r})\n"
        "from machine_runs import Machine, Step, run_all\n"
        f"step = Step('it', (sys.executable, '-c', {code!r}), 600)\n"
        "sys.exit(run_all([Machine('one', '', (step,)), Machine('two', '', (step,))]))"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE) as child:
        while not begun.exists():
            assert child.poll() is None
            time.sleep(0.1)
        begun.unlink()
        child.send_signal(signal.SIGINT)
        assert child.wait(60) == 130
    assert not begun.exists(), "nor is the next one begun"


@pytest.mark.parametrize(
    ("status", "errors", "trouble"),
    [
        (2, "one\nno driver: install it\n", ""),
        (0, "no driver: install it", "exit status 0, expected 2"),
        (-6, "no driver: install it", "exit status -6, expected 2"),
        (2, "no driver: install it\nand more", "its last line is 'and more', expected 'install it' in it"),
        (2, "", "its last line is 'empty', expected 'install it' in it"),
        (2, "Traceback (most recent call last)\ninstall it", "printed 'Traceback', expected an output without it"),
        (None, "install it", "did not end within 9 s"),
    ],
)
def test_an_error_is_expected_with_its_words(status: int | None, errors: str, trouble: str) -> None:
    step = Step("it", (), 9, status=2, says="install it")
    assert wrong(step, status, errors, errors) == trouble


def test_a_machine_without_pips_driver_has_none(tmp_path: Path) -> None:
    code = "from clsplat.device.selection import list_devices as l; import subprocess, sys; print(len(l()))"
    child = code + "; print(subprocess.run([sys.executable, '-c', sys.argv[1]], capture_output=True, text=True).stdout)"
    for name in ("drivers", "no-drivers", "home", "tmp"):
        (tmp_path / name).mkdir()
    row = rows()["none"]
    both = [environment_of(each, tmp_path) for each in (row, replace(row, pypi=True))]
    counts = [calls.python("-c", child, code, env=environment, cwd=ROOT).stdout.split() for environment in both]
    assert counts[0] == ["0", "0"], "nor in a child"
    assert counts[1][0] == counts[1][1]


def test_the_table_is_markdown_where_asked_for() -> None:
    result = run_machine(Machine("one", "a machine", (python(""),)), lambda _: None)
    lines = table([result], markdown=True).splitlines()
    assert lines[1] == "| --- | --- | --- | --- |"
    assert lines[2].startswith("| `one` | a machine | it ")
    assert lines[2].endswith(" | passed |")


def test_a_machine_that_there_is_not_is_refused(capsys: Capture) -> None:
    with pytest.raises(SystemExit) as end:
        machines.main(["--only", "pypi-pocl,zx81"])
    assert end.value.code == 2
    assert "--only zx81: no such machine; there are all, " in capsys.readouterr().err
