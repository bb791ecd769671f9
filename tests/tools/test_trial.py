# SPDX-License-Identifier: Apache-2.0
"""The trial of a GPU: a dry run of every part, what is left out, variants and their bits, and a trial's row."""

from __future__ import annotations

import json
import math
import sys
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import gpu_compilers
import gpu_measured
import numpy as np
import pytest
import trial
import trial_counters
import trial_counts
import trial_peers
from calls import Capture, printed, refuses
from gpu_chain import Chain
from gpu_devices import GPUS, gpu_of
from gpu_model import Constants, Work
from gpu_scenes import fox_like
from trial_table import table
from trial_variants import DRY, OUTPUTS, USUAL, VARIANTS, TrialScene, Variant, VariedDevice, compared

from clsplat.device.context import all_devices
from clsplat.device.drivers.shapes import default_shape
from clsplat.device.program import text_of
from clsplat.device.selection import list_devices
from clsplat.device.source import kernel_root, kernel_source
from clsplat.errors import ClsplatError
from clsplat.training.step.speculative_steps import BY_CAPACITY_VARIABLE

EXPECTED_REASONS = ("a dry run", "nvidia-smi is not", "there is no CUDA", "ncu ", "PyTorch ", "ModuleNotFoundError")
"""Beginnings of reasons to leave something out that a machine of the tests may have."""


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> VariedDevice:
    """The default driver's device in a GPU's shape."""
    monkeypatch.setenv("CLSPLAT_TRUST_DRIVER", "1")
    first = all_devices()[0]
    return VariedDevice(first, default_shape(first).relabelled("1x64"))


@pytest.fixture
def calibration(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A copy of calibration.json, for tools to write."""
    path = tmp_path / "calibration.json"
    path.write_bytes(gpu_measured.CALIBRATION.read_bytes())
    monkeypatch.setattr(trial_counts, "CALIBRATION", path)
    return path


@pytest.mark.slow
def test_a_dry_run_of_every_part(tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "trial.json"
    text = printed(capsys, ["--dry-run", "--out", out], call=trial.main).out
    record = json.loads(out.read_text())
    assert out.with_suffix(".txt").read_text() == text
    assert [row["what"] for row in record["left_out"] if not row["why"].startswith(EXPECTED_REASONS)] == []
    assert record["limits"]["native_recip wrong after two steps"] == 0, "a CPU's reciprocal is at most 3 ulp off"
    assert all(math.isfinite(value) for value in record["limits"].values())
    assert {row["frame"] for row in record["scenes"]} == set(trial.SCENES)
    for row in record["scenes"]:
        assert row["kernels_ms"]["blend_grad"] > 0
        assert row["pairs"]["listed"] > 0
    measured = {(row["scene"], row["variant"]) for row in record["variants"]}
    assert measured == {(scene, variant) for scene in trial.SCENES for variant in DRY}
    for row in record["variants"]:
        sums = row["variant"] in ("1x64g", "blocks of 5 rows")  # in another order
        assert sums or row["bits"] == ("" if row["stage"] == "statistics" else "same"), row


@pytest.mark.slow
def test_no_time_is_left(tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "trial.json"
    text = printed(capsys, ["--dry-run", "--minutes", "1e-9", "--out", out], call=trial.main).out
    record = json.loads(out.read_text())
    assert (record["limits"], record["scenes"], record["variants"]) == ({}, [], [])
    assert "left out, no time was left: limits: clocks; limits: copies; " in text
    assert "made up, 1 M: 1x64" in text


def test_a_killed_trial_keeps_its_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(begun: trial.Trial) -> None:
        begun.add("left_out", {"what": "a part", "why": "for a reason"})
        raise KeyboardInterrupt

    monkeypatch.setattr(trial, "PARTS", {"limits": killed})
    out = tmp_path / "trial.json"
    assert trial.main(["--dry-run", "--out", str(out)]) == 130
    assert json.loads(out.read_text())["left_out"] == [{"what": "a part", "why": "for a reason"}]
    assert out.with_suffix(".txt").read_text().endswith("left out, for a reason: a part\n")


def infos(*kinds: str) -> list[Any]:
    """Entries of the list of devices, of these kinds."""
    return [
        replace(list_devices()[0], index=index, name=f"{kind} {index}", kind=kind) for index, kind in enumerate(kinds)
    ]


def test_a_machine_without_a_gpu(monkeypatch: pytest.MonkeyPatch, capsys: Capture, tmp_path: Path) -> None:
    monkeypatch.setattr(trial, "list_devices", lambda: infos("cpu", "other"))
    assert trial.main(["--out", str(tmp_path / "trial.json")]) == 2
    assert "no GPU among the OpenCL devices (cpu 0; other 1), so all is left out" in capsys.readouterr().err


def test_a_machine_with_two_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    first = all_devices()[0]
    monkeypatch.setattr(trial, "list_devices", lambda: infos("gpu", "cpu", "gpu"))
    monkeypatch.setattr(trial, "all_devices", lambda: [first, None, None])
    monkeypatch.setattr(trial, "select", lambda name: first)
    device, others = trial.chosen_device(Namespace(dry_run=False, device=None))
    assert device.shape.label == "1x64"
    assert others == ["GPU 2, gpu 2"]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--minutes", "0"], "--minutes 0: expected more than 0"),
        (["--out", "trial.txt"], "--out trial.txt: expected a name that ends in .json"),
        (["--peers", "nowhere"], "--peers nowhere: expected a folder"),
    ],
)
def test_wrong_calls(flags: list[str], message: str, capsys: Capture) -> None:
    assert trial.main(["--dry-run", *flags]) == 2
    assert capsys.readouterr().err == f"trial: error: {message}\n"


def test_variants_name_what_there_is(device: VariedDevice) -> None:
    stems = {path.stem for path in kernel_root().glob("*.cl")}
    for variant in VARIANTS:
        assert set(variant.registers) | set(variant.text) <= stems
        assert set(variant.of) <= {*OUTPUTS, "project_step"}, variant.title
        with device.varied(variant):
            assert device.shape.label == variant.shape
            for stem in variant.text:
                assert text_of(stem) != kernel_source(stem)
    assert len({variant.title for variant in VARIANTS}) == len(VARIANTS)
    assert set(DRY) <= {variant.name for variant in VARIANTS}
    assert device.shape.label == "1x64"


def test_copies_of_a_device_follow_its_variant(device: VariedDevice) -> None:
    copy = device.with_switches({"ANTIALIASED": True})
    with device.varied(Variant("wide", shape="1x256")):
        assert copy.shape.items == 256
    assert copy.shape.items == 64


def test_what_a_device_lacks(device: VariedDevice, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trial_variants.most_items", lambda _: 128)
    lacking = {variant.title: variant.lacking(device) for variant in VARIANTS}
    assert lacking["1x256"] == "groups of 256 items do not fit"
    assert lacking["blend, 48 registers"] == "the driver takes no limit of registers"
    assert lacking["1x128"] == ""


@pytest.mark.slow
def test_a_variant_with_other_bits_is_told(device: VariedDevice) -> None:
    scene = TrialScene(fox_like(200, 48, 32), device)
    scene.measure(USUAL, 1)
    wrong = Variant("one tap heavier", ("loss",), text={"loss": "2.66011725e-1f => 2.70000000e-1f"})
    rows = scene.measure(wrong, 1)
    assert {row["kernel"] for row in rows} == {"loss_ssim", "loss_grad"}
    assert all(row["bits"].startswith("off by ") for row in rows)
    assert all(row["bits"] == "same" for row in scene.measure(replace(USUAL, name="again", of=("loss",)), 1))


def test_how_bits_are_compared() -> None:
    one = np.array([3.0, 4.0], np.float32)
    assert compared([one], [one.copy()]) == "same"
    assert compared([one, one], [one, one + np.float32(0.5)]) == "off by 1e-01"
    assert compared([one], [one[:1]]) == "other sizes"
    assert compared([np.array([np.nan], np.float32)], [np.array([np.nan], np.float32)]) == "same"


def test_the_scene_like_fox() -> None:
    one, other = (fox_like(500, 449, 800).gaussians for _ in range(2))
    np.testing.assert_array_equal(one.means, other.means)
    assert 0.7 < np.mean(one.means[:, 2] > 0) < 0.9  # SEEN of 500


def sources(folder: Path, setup: str) -> Path:
    (folder / "gsplat").mkdir(parents=True)
    (folder / "gsplat/setup.py").write_text(setup)
    return folder


@pytest.mark.slow
def test_peers_that_cannot_be_built(tmp_path: Path) -> None:
    folder = sources(tmp_path / "peers", "raise SystemExit('no compiler here')")
    builds = trial_peers.Builds(folder, tmp_path / "built")
    builds.finish(120)
    assert builds.failed["Faster-GS"] == f"no folder Faster-GS in {folder}"
    assert builds.failed["gsplat"].startswith("its build failed: ")
    late = trial_peers.Builds(sources(tmp_path / "late", "import time\ntime.sleep(60)"), tmp_path / "late_built")
    late.finish(0)
    assert late.failed["gsplat"] == "its build was not done in time"


@pytest.mark.slow
def test_a_peer_that_cannot_be_run(tmp_path: Path) -> None:
    told = trial_peers.measure("gsplat", tmp_path / "missing.npz", 1, tmp_path, 120)
    assert isinstance(told, str)
    assert told.startswith(("PyTorch ", "ModuleNotFoundError", "FileNotFoundError")), told  # no CUDA, no PyTorch


@pytest.fixture
def fakes(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[Any]]:
    """Stand-ins for the peers on a CPU. Returns the arguments of each call."""
    torch = pytest.importorskip("torch")
    calls: dict[str, list[Any]] = {"gsplat": [], "Faster-GS": []}

    def rasterization(*shapes: Any, **options: Any) -> Any:
        calls["gsplat"].append((shapes, options))
        *parameters, view, matrix, width, height = shapes
        assert (view.shape, matrix.shape) == ((1, 4, 4), (1, 3, 3))
        total = sum(each.sum() for each in parameters)
        return (total.expand(1, height, width, 3), None, None)

    def diff_rasterize(*, autograd_dummy: Any, rasterizer_settings: Any, **arrays: Any) -> Any:
        calls["Faster-GS"].append((rasterizer_settings, arrays))
        return autograd_dummy.sum().expand(3, rasterizer_settings[5], rasterizer_settings[4]), autograd_dummy

    gsplat, faster = ModuleType("gsplat"), ModuleType("rasterization")
    gsplat.rasterization = rasterization  # type: ignore[attr-defined]
    faster.diff_rasterize, faster.RasterizerSettings = diff_rasterize, lambda *given: given  # type: ignore[attr-defined]
    name = "FasterGSFusedCudaBackend"
    packages = {name: ModuleType(name), f"{name}.torch_bindings": ModuleType("torch_bindings")}
    for key, module in {**packages, f"{name}.torch_bindings.rasterization": faster, "gsplat": gsplat}.items():
        monkeypatch.setitem(sys.modules, key, module)
    monkeypatch.setitem(sys.modules, "fused_ssim", None)
    monkeypatch.setattr(trial_peers, "DEVICE", "cpu")
    monkeypatch.setattr(torch.optim, "Adam", lambda given, lr, fused: torch.optim.SGD(given, lr=lr))
    return calls


@pytest.mark.needs("torch")
def test_what_the_peers_are_given(fakes: dict[str, list[Any]], tmp_path: Path) -> None:
    import torch

    subject = fox_like(20, 48, 32)
    trial_peers.save(subject, np.zeros((32, 48, 3), np.float32), tmp_path / "subject.npz")
    with np.load(tmp_path / "subject.npz") as loaded:
        data = {name: loaded[name] for name in loaded.files}
    for peer in trial_peers.TIMED:
        frame, step, told = trial_peers.steps_of(peer, data, torch)
        frame()
        step()
        step()
        assert told == "L1"
    shapes, options = fakes["gsplat"][-1]
    assert options == {"sh_degree": 3, "packed": False}
    np.testing.assert_allclose(shapes[2].detach(), np.exp(subject.gaussians.log_scales), rtol=1e-6)
    np.testing.assert_array_equal(shapes[4].detach(), subject.gaussians.sh)
    assert all(each.requires_grad for each in shapes[:5])
    settings, arrays = fakes["Faster-GS"][-1]
    camera = subject.camera
    assert settings[3:10] == (16, 48, 32, camera.fx, camera.fy, camera.cx, camera.cy)
    assert settings[-1] == 2, "Adam's second step"
    assert arrays["moments_sh_coefficients_rest"].shape == (20, 15, 3, 2)


@pytest.mark.slow
def test_parts_that_need_cuda(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Capture) -> None:
    """Of two programs on two scenes one cannot be run; counters are asked for once, of the first scene."""
    answers = {"gsplat": {"frame_ms": 1.5, "step_ms": 6.5, "loss": "L1"}, "Faster-GS": "a reason"}
    counted = [{"kernel": "blend", "counted": {"time": "7 us"}}]
    monkeypatch.setattr(trial, "PARTS", {"counters": trial.count_hardware, "peers": trial.measure_peers})
    monkeypatch.setattr(trial_peers, "no_cuda", lambda: "")
    monkeypatch.setattr(trial.shutil, "which", lambda _: "ncu")
    monkeypatch.setattr(trial_peers, "measure", lambda peer, *_: answers[peer])
    monkeypatch.setattr(trial_counters, "measure", lambda *_: counted)
    out = tmp_path / "trial.json"
    flags = ["--dry-run", "--out", out, "--twins", tmp_path, "--peers", tmp_path]
    text = printed(capsys, flags, call=trial.main).out
    found = json.loads(out.read_text())
    assert found["counters"] == [{"scene": "made up, 1 M", **counted[0]}]
    assert [(row["scene"], row["peer"]) for row in found["peers"]] == [(scene, "gsplat") for scene in trial.SCENES]
    assert "left out, a reason: Faster-GS: made up, 1 M; Faster-GS: fox-like" in text
    assert f"left out, no folder gsplat in {tmp_path}: gsplat, built from source" in text
    assert printed(capsys, flags[:3], call=trial.main).out.splitlines()[-2].startswith("left out, ncu sees no OpenCL; ")


def test_kernels_for_cuda(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Capture) -> None:
    launches = [{"kernel": kernel, "stem": stem} for kernel, stem in (("blend", "blend"), ("project", "project"))]
    step = [{"options": ["-DITEMS=64"], "local": [64], "shared": 0, **launch} for launch in launches]

    def assembled(source: Any, target: str, builtins: Path, folder: Path) -> Path:
        path = folder / f"{source.stem}.s"
        path.write_text(f"{source.stem} for {target}, {builtins.name}")
        return path

    monkeypatch.setattr(gpu_compilers, "ask_package", lambda *_: [step])
    monkeypatch.setattr(gpu_compilers, "build_builtins", lambda target, folder: folder / "built.bc")
    monkeypatch.setattr(gpu_compilers, "assembled", assembled)
    folder = tmp_path / "twins"
    told = printed(capsys, ["--write-twins", folder, "--target", "sm_89"], call=trial.main).out
    assert told == f"{folder}: blend\n"
    assert {path.name: path.read_text() for path in folder.iterdir()} == {"blend.ptx": "blend for sm_89, built.bc"}


def test_counters_of_ncu() -> None:
    text = """==PROF== Connected
"ID","Kernel Name","dram__bytes.sum","gpu__time_duration.sum","another"
"","","Mbyte","us",""
"0","blend","111.8","667.2","7"
"1","loss_grad","123.3","181","7"
"""
    assert trial_counters.counters_of(text) == [
        {"kernel": "blend", "counted": {"bytes of memory": "111.8 Mbyte", "time": "667.2 us"}},
        {"kernel": "loss_grad", "counted": {"bytes of memory": "123.3 Mbyte", "time": "181 us"}},
    ]


@pytest.mark.slow
def test_launches_for_their_twins(device: VariedDevice, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each kernel's arguments in order, as they are before its first launch of a step by capacity. These launches have
    the order of tiles, which the CUDA copies expect: ncu would crash without it."""
    monkeypatch.setenv(BY_CAPACITY_VARIABLE, "1")
    trial_counters.dump(fox_like(200, 48, 32), device, trial_counters.TWINS, tmp_path)
    assert {path.stem for path in tmp_path.iterdir()} == set(trial_counters.TWINS)
    launch, values = trial_counters.arguments_of(tmp_path / "blend.npz")
    first, tiles_x, width, height, ranges, *arrays = values
    assert (launch["local"], math.prod(launch["size"])) == ([64], 64 * 3 * 2)
    assert (int(first), int(tiles_x), int(width), int(height)) == (0, 3, 48, 32)
    assert ranges.view(np.uint32).reshape(-1, 2)[:6, 1].max() > 0
    assert len(arrays) == 9, "the sorted list, splats, background, three planes, two of the parts of lists, the order"
    refuses("has no kernel", trial_counters.measure, None, None, tmp_path / "x", 1, error=OSError)


RECORD: dict[str, Any] = {
    "device": "NVIDIA H100 80GB HBM3",
    "driver": "a driver",
    "date": "2026-12-01",
    "commit": "abcdef12",
    "code": "",
    "shape": "1x64",
    "dry_run": False,
    "limits": {"clock": 1980},
    "scenes": [
        {
            "scene": "synthetic",
            "frame": "made up, 1 M",
            "shape": shape,
            "gaussians": 7,
            "visible": 6,
            "pairs": {"listed": 5},
        }
        | {"frame_ms": 1.0, "step_ms": 3.0, "step_in_a_row_ms": 2.5, "host_ms": 0.5, "kernels_ms": {"blend": 0.4}}
        for shape in ("1x64", "1x32")
    ],
    "variants": [
        {"scene": "made up, 1 M", "kernel": "blend", "stage": "blend", "variant": name, "ms": 0.5, "bits": "same"}
        for name in ("1x64", "1x32")
    ],
    "counters": [],
    "peers": [{"scene": "made up, 1 M", "peer": "gsplat", "frame_ms": 2.0, "step_ms": 7.0, "loss": "L1"}],
    "left_out": [{"what": "a", "why": "no time"}, {"what": "b", "why": "no time"}],
}


def record(**changes: Any) -> dict[str, Any]:
    return {**json.loads(json.dumps(RECORD)), **changes}


def test_the_names_of_gpus() -> None:
    names = {gpu.name: gpu_of(f"NVIDIA GeForce {gpu.name}") for gpu in GPUS if gpu.name.startswith("RTX")}
    assert all(found is not None and found.name == name for name, found in names.items())
    for name, ours in {"NVIDIA H100 80GB HBM3": "H100 SXM", "NVIDIA H200": "H200"}.items():
        found = gpu_of(name)
        assert found is not None and found.name == ours
    assert gpu_of("NVIDIA GeForce RTX 3090 Ti") is None
    assert gpu_of("NVIDIA H100 PCIe") is None


def test_counts_and_predictions_of_variants(monkeypatch: pytest.MonkeyPatch, calibration: Path) -> None:
    """A million instructions of blend, twice as many in the second form, and another kernel that does not count."""
    gpu, constants = gpu_of(RECORD["device"]), Constants(efficiency=1.0)
    assert gpu is not None and calibration.exists()

    def works(variant: Variant, target: str, frames: Any) -> list[list[Work | None]]:
        assert (target, [frame["name"] for frame in frames]) == ("sm_90", ["made up, 1 M"])
        more = 1 + (variant.name == "1x32")
        return [[Work("blend", 0, more * 1e9, kernel="blend"), None, Work("loss", 0, 1e9, kernel="loss_ssim")]]

    monkeypatch.setattr(trial_counts, "works_of_variant", works)
    monkeypatch.setattr(trial_counts, "fit_constants", lambda *_: constants)
    found = record()
    trial_counts.count_variants(found)
    assert [row["counted"] for row in found["variants"]] == [1000, 2000]
    assert found["variants"][0]["predicted_ms"] == pytest.approx(1e9 / gpu.issued)
    lines = table(found)
    assert ["blend", "1x64", "1000.0", "0.9565", "0.5000", "1.91", "same"] in [line.split() for line in lines], lines
    assert lines[-1] == "left out, no time: a; b"


def test_a_trials_row_of_the_calibration(monkeypatch: pytest.MonkeyPatch, calibration: Path) -> None:
    work = Work("blend", 1e9, 1e6, 20, 10, 8, Chain(1, 2, 3), Chain(4, 5, 6), "blend")
    monkeypatch.setattr(trial_counts, "works_of_variant", lambda *_: [[work]])
    before = len(json.loads(calibration.read_text()))
    trial_counts.add_row(record())
    trial_counts.add_row(record(limits={"clock": 1700.00049}))
    rows = json.loads(calibration.read_text())
    assert len(rows) == before + 1, "the second replaces the first"
    assert rows[-1]["limits"] == {"clock": 1700.0}
    assert [scene["frame"] for scene in rows[-1]["scenes"]] == ["made up, 1 M"], "in the usual shape alone"
    measured, unused = gpu_measured.read(rows[-1:], {})
    assert unused == []
    assert (measured[0].gpu.name, measured[0].ms["blend"], measured[0].works) == ("H100 SXM", 0.5, [work])


def test_a_trial_that_is_not_used_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    path = tmp_path / "trial.json"
    code = trial.digest_of_code()
    for found, message in (
        (record(code="older"), "measured other code, of commit abcdef12; check that out first"),
        (record(code=code, dry_run=True), "is a dry run, which measured no GPU"),
        (record(code=code, device="NVIDIA H300"), "NVIDIA H300: not among GPUS in gpu_devices.py"),
    ):
        path.write_text(json.dumps(found))
        assert trial.main(["--complete", str(path)]) == 2
        assert message in capsys.readouterr().err
    assert json.loads(path.read_text()) == record(code=code, device="NVIDIA H300"), "nothing is written"


def test_a_part_that_fails_is_told(tmp_path: Path) -> None:
    options = Namespace(dry_run=True, minutes=1, peers=None, twins=None, out=tmp_path / "trial.json")
    first = all_devices()[0]
    begun = trial.Trial(options, VariedDevice(first, default_shape(first)), tmp_path)

    def fails() -> None:
        raise ClsplatError("many lines\n\nof which the last counts\n")

    begun.attempt("a piece", fails)
    assert begun.record["left_out"] == [{"what": "a piece", "why": "of which the last counts"}]
