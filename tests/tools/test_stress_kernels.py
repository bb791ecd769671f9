# SPDX-License-Identifier: Apache-2.0
"""A sample of `tools/stress/run kernels`, and that it would find what is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import stress_kernels
from calls import python
from hypothesis import given, settings
from hypothesis import strategies as st
from stress_cases import GRADIENT_NORM, GRADIENT_TAIL, PROJECTION, STRESSORS
from stress_frames import SCENES, compare_8k
from stress_frames import compare as compare_frame
from stress_projection import compare
from stress_stages import stages

from clsplat import camera as clsplat_camera
from clsplat.device.context import Device
from clsplat.layouts import columns
from clsplat.reference.loss import l1_dssim
from clsplat.selftest.cases import loss
from clsplat.stages import device_camera, project

ROOT = Path(__file__).resolve().parents[2]
SEEDS = st.integers(0, 2**32 - 1)
QUICK = settings(max_examples=4, deadline=None, derandomize=True, database=None)


@pytest.mark.slow
@pytest.mark.parametrize("name", STRESSORS)
def test_projection_and_its_gradient_under(name: str, default_device: Device) -> None:
    stressor = STRESSORS[name]

    @QUICK
    @given(SEEDS)
    def check(seed: int) -> None:
        rng = np.random.default_rng(seed)
        found = compare(default_device, stressor.make(rng, 300), rng, finite_only=stressor.finite)
        assert not any(found.broken.values()), found.broken
        if not found.shown.any():
            return
        for error, bound in {**PROJECTION, **stressor.bounds}.items():
            if error in found.errors:
                assert np.nanmax(found.errors[error]) <= bound, error
        for group, (off, size) in found.norms.items():
            assert off**0.5 <= GRADIENT_NORM * size**0.5, group
            # 99.9 % of 300 would be all of them: one gradient of a thousand may vanish by chance
            assert np.nanquantile(found.errors[f"d {group}"], 0.99) <= GRADIENT_TAIL, group

    check()


@pytest.mark.parametrize("name", [name for name in SCENES if name not in stress_kernels.SLOW])
def test_frames_and_their_gradients_of(name: str, device: Device) -> None:
    found = stress_kernels.frames(device, name, 2, seed=1)
    # of so few Gaussians the 99.9th percentile is nearly the largest, see above
    assert [fault for fault in found["faults"] if "99.9" not in fault] == []


@pytest.mark.slow
def test_ten_thousand_on_one_pixel(default_device: Device) -> None:
    rng = np.random.default_rng(0)
    found = compare_frame(default_device, SCENES["one_pixel"](rng), rng)
    assert found.finite and found.image <= 2e-5
    assert all(off <= GRADIENT_NORM**2 * size for off, size in found.norms.values())


@pytest.mark.slow
def test_large_frame(default_device: Device) -> None:
    found = compare_8k(default_device, np.random.default_rng(0), count=300, crops=4)
    assert found.finite and found.image <= 2e-5


def test_equal_scales_have_no_gradient_of_rotation(default_device: Device) -> None:
    rng = np.random.default_rng(2)
    cases = STRESSORS["balls"].make(rng, 200)
    cases.gaussians.log_scales[:] = cases.gaussians.log_scales[:, :1]
    found = compare(default_device, cases, rng)
    assert found.shown.sum() > 100
    assert np.nanmax(found.errors["d quaternions"]) == 0


@pytest.mark.parametrize(
    ("field", "by", "error"),
    [("FX", 1e-5, "position "), ("R00", 1e-3, "shape "), ("PX", 1e-3, "colour "), ("NEAR", 3.0, "culled, visible")],
)
def test_a_wrong_camera_is_found(
    field: str, by: float, error: str, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last one culls Gaussians that are visible."""
    good = device_camera.pack_camera

    def wrong(camera: clsplat_camera.Camera) -> project.NDArray[np.float32]:
        packed = good(camera)
        packed[columns.CAMERA.index(field)] += np.float32(by * max(1.0, abs(packed[columns.CAMERA.index(field)])))
        return packed

    monkeypatch.setattr(device_camera, "pack_camera", wrong)
    row = stress_kernels.judged("ordinary", stress_kernels.projections(default_device, "ordinary", 500, seed=0))
    assert any(error in fault for fault in row["faults"])


@pytest.mark.slow
def test_stages_by_themselves(default_device: Device) -> None:
    """With random inputs; tests/stages/test_cases.py has each case on every driver."""
    assert stages(default_device, seed=1, many=4)["faults"] == []


@pytest.mark.slow
def test_a_wrong_loss_is_found(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loss, "l1_dssim", lambda x, y, weight: l1_dssim(x, y, weight + 1e-3))
    faults = stages(default_device, seed=1, many=2)["faults"]
    assert any(fault.startswith("loss: gradient") for fault in faults)


@pytest.mark.slow
def test_command(tmp_path: Path) -> None:
    plot = tmp_path / "errors.svg"
    flags = "--cases 600 --only scales,counts,wild --json --plot"
    done = python(ROOT / "tools" / "stress" / "run", "kernels", *flags.split(), plot)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["cases"] >= 600
    assert result["projection"]["scales"]["errors"]["shape"]["bound"] == PROJECTION["shape"]
    assert result["frames"]["counts"]["gradients"]["means"]["norm"] < GRADIENT_NORM
    assert plot.stat().st_size > 1000


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        pytest.param(["nothing"], marks=pytest.mark.slow),
        ["kernels", "--only", "nobody"],
        pytest.param(["kernels", "--cases", "0"], marks=pytest.mark.slow),
    ],
)
def test_wrong_calls(arguments: list[str]) -> None:
    done = python(ROOT / "tools" / "stress" / "run", *arguments)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
