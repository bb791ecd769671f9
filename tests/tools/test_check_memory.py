# SPDX-License-Identifier: Apache-2.0
"""The check by Oclgrind: what it reads of a log, what it does to kernels, and that it finds what is planted."""

from __future__ import annotations

import re
from pathlib import Path

import check_memory
import pytest
from calls import printed
from check_memory import CHECKS, Finding, Result, findings, kernels, places, report, report_planted
from memory_stand_ins import by_elements
from memory_workload import WHOLE_ONLY, build_of

from clsplat.config.colour_models import COLOUR_MODELS
from clsplat.device.context import Device
from clsplat.device.source import kernel_root, kernel_source

STEMS = sorted({stem for stems in kernels().values() for stem in stems})
LOG = """
Oclgrind - OpenCL runtime error detected
\tFunction: clGetDeviceInfo
\tError:    CL_INVALID_VALUE
\tFor argument 'param_name'

1 warning generated.

Uninitialized value written to global memory address 0x8000000000000
\tKernel: ranges
\tEntity: Global(0,0,0) Local(0,0,0) Group(0,0,0)
\t  store i32 %17, i32 addrspace(1)* %arrayidx19, align 4, !dbg !83
\tAt line LINE (column 51) of input.cl:
\t  ranges[2 * tile] = i;

Write-write data race at global memory address 0x1000000000000
\tKernel: scan_chunks

"""
TEXT = "if (i >= pairs) return;"


def number_of(stem: str, text: str) -> int:
    """The line, from 1, of the text that a driver gets."""
    return next(i for i, line in enumerate(kernel_source(stem).splitlines(), 1) if text in line)


def test_findings_name_the_kernels_line() -> None:
    found, accepted = findings(LOG.replace("LINE", str(number_of("ranges", TEXT))), kernels())
    line = next(i for i, each in enumerate((kernel_root() / "ranges.cl").read_text().splitlines(), 1) if TEXT in each)
    written = "Uninitialized value written to global memory address 0x..."
    raced = "Write-write data race at global memory address 0x..."
    assert set(found) == {Finding(written, "ranges", f"kernels/ranges.cl:{line}"), Finding(raced, "scan_chunks")}
    assert sum(accepted.values()) == 1


def test_a_kernel_of_several_files_has_a_place_in_each() -> None:
    assert kernels()["develop"] == sorted(COLOUR_MODELS)
    (found,), _ = findings("Invalid read\n\tKernel: develop\n\tAt line 9 of input.cl\n", kernels())
    assert found.place == f"{places('exposure')[8]} or {places('ppisp')[8]}"


@pytest.mark.parametrize("stem", STEMS)
def test_places_are_those_of_the_text(stem: str) -> None:
    lines = kernel_source(stem).splitlines()
    listed = places(stem)
    assert len(listed) == len(lines)
    for line, place in zip(lines, listed, strict=True):
        name, _, number = place.partition(":")
        if name != "layout":
            path = kernel_root().parent / name if name.startswith("kernels/") else None
            assert path is not None
            assert (kernel_root() / name.removeprefix("kernels/")).read_text().splitlines()[int(number) - 1] == line


@pytest.mark.parametrize("log", ["OCLGRIND FATAL ERROR (WorkItem.cpp:1)\nUnsupported\n", "Something new\n", LOG])
def test_whatever_is_logged_is_a_finding(log: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert not report(Result("1x64 races", 0, "", log.replace("LINE", "9"), 1.0), kernels())
    assert report(Result("1x64 races", 0, "", "", 1.0), kernels())
    assert not report(Result("1x64 races", -11, "scan_chunks", "", 1.0), kernels())
    assert "the last kernel was scan_chunks" in capsys.readouterr().out


def test_a_kernel_that_never_ran_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    ran = " ".join(sorted(set(kernels()) - {"scan_chunks"}))
    monkeypatch.setattr(check_memory, "library", lambda: Path("driver"))
    monkeypatch.setattr(check_memory, "run", lambda shape, check, *_, **_named: Result(shape, 0, ran, "", 0.0))
    monkeypatch.setattr(check_memory, "report_planted", lambda *_: True)
    assert "never ran: scan_chunks" in printed(capsys, ["--shapes", "8x1"], status=1, call=check_memory.main).out


@pytest.mark.parametrize("short", [True, False])
def test_the_short_form_leaves_out_no_build(
    short: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """A build of 1x64 that only such parts have as the short form leaves out is told by the whole check."""
    everywhere = " ".join(f"{name}@{stems[0]}" for name, stems in kernels().items())

    def run(shape: str, check: str, part: str, *_: object, **named: object) -> Result:
        assert named == {"short": short} and not (short and part in WHOLE_ONLY)
        alone = " blend@blend,SECRET" if (shape == "1x64") == (part in WHOLE_ONLY) else ""
        return Result(f"{shape} {check} {part}", 0, everywhere + alone, "", 0.0)

    monkeypatch.setattr(check_memory, "library", lambda: Path("driver"))
    monkeypatch.setattr(check_memory, "run", run)
    monkeypatch.setattr(check_memory, "report_planted", lambda *_: True)
    arguments = [*(["--short"] if short else []), "--keep", str(tmp_path)]
    out = printed(capsys, arguments, status=int(not short), call=check_memory.main).out
    told = [f"{check}, the short form would leave out: 1x64 blend@blend,SECRET" for check in CHECKS]
    assert [line for line in out.splitlines() if "leave out" in line] == ([] if short else told)
    assert "8x1 blend@blend,SECRET" in (tmp_path / "builds.txt").read_text().splitlines()


@pytest.mark.parametrize("shape", ["8x1", "1x64"])
def test_a_build_is_a_word_with_its_defines(shape: str, default_device: Device) -> None:
    kernel = default_device.with_shape(shape).kernels("target", {"MASKED": True, "ALPHA": True}).target
    assert re.fullmatch(r"target@target,ALPHA,(FMA_BY_CONTRACTION,)?(LANES=\d+,)?MASKED", build_of(kernel))


def test_without_oclgrind(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(check_memory, "library", lambda: None)
    assert "apt install oclgrind" in printed(capsys, [], status=2, call=check_memory.main).err


def test_vectors_are_made_of_elements() -> None:
    assert by_elements("x = (float8)(a.lo, b.hi);", 8) == (
        "x = (float8)(a.s0, a.s1, a.s2, a.s3, b.s4, b.s5, b.s6, b.s7);"
    )
    for stem in STEMS:
        text = by_elements(kernel_source(stem), 8)
        assert text.count("\n") == kernel_source(stem).count("\n")  # or findings would name other lines
        assert not re.search(r"\(float8\)\(\w+\.(lo|s01)", text)
        assert "image_gradient + pixel, stride) & inside" not in text


@pytest.mark.slow
@pytest.mark.needs("oclgrind")
@pytest.mark.parametrize("check", CHECKS)
def test_planted_faults_are_found(check: str, tmp_path: Path) -> None:
    driver = check_memory.library()
    assert driver is not None
    assert report_planted(check_memory.run("planted", check, "", driver, tmp_path), check)
