# SPDX-License-Identifier: Apache-2.0
"""Work under --max-device-mem: the same bytes as without, and never more memory than allowed."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from calls import printed, refuses
from compare import assert_same_bits
from quick import quick
from same_bytes import model_bytes, opened_again
from scenes import random_cloud
from tiny import CONFIG, run_steps, short, trained_to, write_scene

import clsplat
from clsplat.cli.main import main
from clsplat.config.rasterizer import BenchSwitches, RasterizerConfig
from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.errors import CapacityError
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.layouts.columns import SlotFields
from clsplat.rendering.memory_needs import StepMemory, plan_frame, plan_step
from clsplat.rendering.memory_plan import Need, plan
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.rendering.renderer import Renderer
from clsplat.runs.run import Run
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.stages.adam import AdamStep
from clsplat.stages.density import new_statistics
from clsplat.stages.device_gaussians import HostGaussians, upload_gaussians
from clsplat.stages.loss import loss
from clsplat.stages.project import ViewSlots, project_step
from clsplat.stages.target import target
from clsplat.training.trainer import Trainer

KIB = 1024


# Frames


@pytest.mark.parametrize(
    ("config", "share"),
    [
        *((RasterizerConfig(), share) for share in (0.9, 0.5, 0.4)),
        (BenchSwitches(tile_test="square", depth_sort="pairs"), 0.5),
    ],
    ids=["nine tenths", "half", "two fifths", "half, all pairs sorted"],
)
def test_a_frame_in_less_memory(default_device: Device, config: RasterizerConfig, share: float) -> None:
    scene, camera = random_cloud(6000, 11, 100, 80)
    free = default_device.with_memory_limit(None)
    wanted = Renderer(free, config=config).render(scene, camera, (0.1, 0.2, 0.3))
    limit = int(share * free.memory.peak)
    device = default_device.with_memory_limit(limit)
    got = Renderer(device, config=config).render(scene, camera, (0.1, 0.2, 0.3))
    assert device.memory.peak <= limit
    assert_same_bits(got.image, wanted.image)
    assert_same_bits(got.alpha, wanted.alpha)


def test_frames_of_many_sizes_and_models(default_device: Device) -> None:
    device = default_device.with_memory_limit(2000 * KIB)
    renderer, plain = Renderer(device), Renderer(default_device)
    for count, width, height in ((500, 60, 40), (3000, 200, 150), (5000, 320, 200), (500, 40, 40)):
        gaussians, camera = random_cloud(count, 3, width, height)
        assert_same_bits(renderer.render(gaussians, camera).image, plain.render(gaussians, camera).image)
    assert device.memory.peak <= 2000 * KIB


def test_too_little_says_how_much_is_needed(default_device: Device) -> None:
    gaussians, camera = random_cloud(4000, 11, 200, 150)
    with pytest.raises(CapacityError, match=r"4,000 Gaussians .* at least about [\d,]+ KiB of device memory"):
        Renderer(default_device.with_memory_limit(300 * KIB)).render(gaussians, camera)


# Training


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return load_scene(write_scene(tmp_path_factory.mktemp("tiny") / "scene", points=False))


MANY = short(
    random_points=400,
    eval_at=(9, 22),
    density={"gradient_threshold": 1e-4, "max_gaussians": 2500, "opacity_reset_every": 35},
)
"""CONFIG with Gaussians that become so many that memory is a matter of them and not of the planes."""


@pytest.fixture(scope="module")
def unlimited(scene: Scene, default_device: Device, tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, int]:
    """model.ply of MANY, and the most memory that its training had."""
    device = default_device.with_memory_limit(None)
    return model_bytes(scene, MANY, device, tmp_path_factory.mktemp("unlimited")), device.memory.peak


@pytest.mark.parametrize("share", quick([0.95, 0.6, 0.4, 0.26], 0.26))
def test_training_in_less_memory_gives_the_same_bytes(
    scene: Scene, default_device: Device, unlimited: tuple[bytes, int], share: float, tmp_path: Path
) -> None:
    wanted, peak = unlimited
    limit = int(share * peak)
    device = default_device.with_memory_limit(limit)
    assert model_bytes(scene, MANY, device, tmp_path / "run") == wanted
    assert device.memory.peak <= limit


def test_what_is_streamed_and_banded_and_resumed(
    scene: Scene, default_device: Device, unlimited: tuple[bytes, int], tmp_path: Path
) -> None:
    """Stopped under a limit, resumed without one: the same bytes again."""
    wanted, peak = unlimited
    device = default_device.with_memory_limit(int(0.26 * peak))
    trainer = Trainer(scene, MANY, device)
    assert not trainer.plan.streamed, "it grows into it"
    run_steps(32, trainer)
    assert trainer.plan.streamed
    assert isinstance(trainer.parameters, HostGaussians)
    assert trainer.parameters.count > 2 * trainer.parameters.rows
    frame = trainer.rasterizer.forward(trainer.parameters, trainer.views[0].camera, trainer.background)
    assert len(frame.bands) > 1
    run = Run.create(tmp_path / "run", MANY)
    arrays, state = trainer.checkpoint()
    run.save_checkpoint(trainer.step, arrays, {**state, "seconds": 1.0})
    assert model_bytes(scene, MANY, default_device, tmp_path / "run", resume=True) == wanted


def test_resumed_under_a_limit(
    scene: Scene, default_device: Device, unlimited: tuple[bytes, int], tmp_path: Path
) -> None:
    trainer = trained_to(17, scene, MANY, default_device)
    run = Run.create(tmp_path / "run", MANY)
    arrays, state = trainer.checkpoint()
    run.save_checkpoint(trainer.step, arrays, {**state, "seconds": 1.0})
    device = default_device.with_memory_limit(int(0.4 * unlimited[1]))
    assert model_bytes(scene, MANY, device, tmp_path / "run", resume=True) == unlimited[0]
    assert device.memory.peak <= 0.4 * unlimited[1]


def test_a_small_training_that_fits_is_not_cut(scene: Scene, default_device: Device) -> None:
    trainer = Trainer(scene, CONFIG, default_device)
    assert not trainer.plan.streamed
    assert (trainer.plan.bands, trainer.plan.gathers) == (1, True)


def test_no_buffer_is_over_the_devices_limit_of_one(
    scene: Scene, default_device: Device, unlimited: tuple[bytes, int], tmp_path: Path
) -> None:
    device = default_device.with_memory_limit(None)
    device.max_allocation = 180 * KIB
    assert model_bytes(scene, MANY, device, tmp_path / "run") == unlimited[0]


# The needs


@pytest.mark.slow
@pytest.mark.parametrize("capacity", [None, 3000])
def test_the_needs_are_those_of_the_arrays(default_device: Device, capacity: int | None) -> None:
    """Memory of a step, at once and in bands, against what the stages say. They may say more: of the photograph, and
    of Gaussians that are not visible."""
    device = default_device.with_memory_limit(2**40)  # a limit, so that no array has room to spare
    gaussians, camera = random_cloud(6000, 11, 100, 80)
    fields = SlotFields(absolute=True, contributions=True)
    config = RasterizerConfig()
    need = plan_step(device, 6000, 16, [camera], config, StepMemory(fields)).need
    rasterizer = Rasterizer(device, config)
    rasterizer.capacity = capacity or rasterizer.capacity
    model, first, second = (upload_gaussians(device, gaussians) for _ in range(3))
    background = upload(device, np.zeros(3, np.float32))
    statistics = new_statistics(device, 6000, contributions=True)
    frame = rasterizer.forward(model, camera, background)
    photograph = target(device, rasterizer.work, np.zeros((80, 100, 4), np.float32), background)
    result = loss(device, rasterizer.work, frame.blended.image, photograph, (100, 80), 0.2)
    slots, screen = rasterizer.pair_gradients(frame, result.gradient, fields=fields), rasterizer.screen(6000, fields)
    view = (ViewSlots(frame.camera_array, frame.projected, slots), screen, rasterizer.readback)
    rates = dict.fromkeys(PARAMETER_GROUPS, 1e-3)
    project_step(device, AdamStep(OptimiserConfig(), 1, rates), (model, first, second), *view)
    assert len(frame.bands) == 1 if capacity is None else len(frame.bands) > 2
    pairs = frame.listed.pairs.tile_keys.shape[0] if capacity is None else capacity
    rows = need.row + need.model + (need.banded if capacity else 0)
    estimate = need.planes + need.scratch + need.gaussians * rows + pairs * need.pair
    assert 0.8 * estimate < device.memory.peak <= estimate
    del statistics


def test_the_needs_of_a_batch_are_those_of_its_arrays(scene: Scene, default_device: Device) -> None:
    """On the device that has the model, and on another."""
    devices = [each.with_memory_limit(2**40) for each in (default_device, opened_again(default_device))]
    config = short(batch=2, iterations=2, random_points=6000, sh_degree_every=0, warmup=())
    trainer = Trainer(scene, config, devices[0], further=devices[1:])
    trainer.train_step()
    trainer.close()
    assert trainer.batch is not None
    rasterizers = (trainer.rasterizer, trainer.batch.replicas[0].rasterizer)
    for rasterizer, device in zip(rasterizers, devices, strict=True):
        plan = trainer.plan if rasterizer is trainer.rasterizer else trainer.batch.replicas[0].plan
        assert plan is not None
        pairs = rasterizer.work.array("tile_keys", (0,), np.uint32, kept=True).buffer.size // 4
        estimate = plan.need.total + (pairs - plan.need.pairs) * plan.need.pair
        # statistics are planned for on both devices, and kept on the first alone
        assert 0.7 * estimate < device.memory.peak <= estimate


def test_the_needs_of_a_frame_are_those_of_its_arrays(default_device: Device) -> None:
    device = default_device.with_memory_limit(2**40)
    gaussians, camera = random_cloud(6000, 11, 100, 80)
    need = plan_frame(device, 6000, 59, camera, RasterizerConfig()).need
    rasterizer = Rasterizer(device)
    background = upload(device, np.zeros(3, np.float32))
    frame = rasterizer.forward(upload_gaussians(device, gaussians), camera, background, backward=False)
    estimate = need.total + (frame.listed.pairs.tile_keys.shape[0] - need.pairs) * need.pair
    assert 0.8 * estimate < device.memory.peak <= estimate


# The plan

ROW = {"model": 4 * 4 * 59, "widest": 4 * 45, "row": 132, "banded": 40, "pair": 76, "most_pairs": 2**31 // 36}
STEP = Need(gaussians=100_000, **ROW, planes=50 * 2**20, scratch=2**20)


def planned(mebibytes: float, need: Need = STEP, largest: int = 2**31) -> str:
    return str(plan(need, int(mebibytes * 2**20), largest, 32))


def test_the_plan_in_words() -> None:
    assert planned(1000) == "about 211.6 MiB of device memory needed, 1,000.0 MiB allowed: all at once"
    assert planned(190).endswith("190.0 MiB allowed: the image is rendered in about 2 bands of tiles")
    assert "allowed: parameters are streamed, 20,128 Gaussians at a time, the image" in planned(140)
    refuses(r"at least about 68.4 MiB of device memory, or 211.6 MiB to be processed", planned, 65, error=CapacityError)
    small = Need(gaussians=40, **ROW, planes=50_000, scratch=1024)
    with pytest.raises(CapacityError, match=r"about [0-9]+ KiB .* KiB to be processed at once, but 4,000 bytes are"):
        plan(small, 4000, 2**31, 32)


def test_pieces_are_no_smaller_than_need_be() -> None:
    for mebibytes in range(70, 400, 5):
        made = plan(STEP, mebibytes * 2**20, 2**31, 32)
        parameters = made.rows * STEP.model
        rest = STEP.planes + STEP.scratch + STEP.gaussians * (STEP.row + STEP.banded) + made.pairs * STEP.pair
        assert parameters + rest <= mebibytes * 2**20
        assert made.streamed == (made.rows < STEP.gaussians)
        assert made.rows % 32 == 0


def test_the_command_line_says_what_it_will_do(
    tmp_path: Path, unlimited: tuple[bytes, int], capfd: pytest.CaptureFixture[str]
) -> None:
    call = ["train", str(write_scene(tmp_path / "scene")), "-o", str(tmp_path / "run"), "--iterations", "3"]
    assert main([*call, "--max-device-mem", "350KiB"]) == 0
    said = capfd.readouterr().err
    assert re.search(r"40 Gaussians: about \d+ KiB of device memory needed, 350 KiB allowed: the image is", said), said
    assert main([*call, "--overwrite"]) == 0
    assert "device memory" not in capfd.readouterr().err
    assert main(["eval", str(tmp_path / "run"), "--max-device-mem", "10KiB"]) == 1
    assert "40 Gaussians at this size of image need at least about" in capfd.readouterr().err
    sparse = str(tmp_path / "scene" / "sparse" / "0")
    call = ["render", str(tmp_path / "run"), "--cameras", sparse, "-o", str(tmp_path / "{name}.exr")]
    assert main([*call, "--max-device-mem", "1M"]) == 0


@pytest.mark.slow
def test_bench_under_a_limit(capsys: pytest.CaptureFixture[str]) -> None:
    call = ["bench", "--gaussians", "2000", "--size", "96x64", "--repeat", "1", "--json"]
    limits = [], ["--max-device-mem", "1.2MiB"]
    found = [json.loads(printed(capsys, [*call, *limit]).out) for limit in limits]
    assert found[0]["pairs"] == found[1]["pairs"]
    assert found[0]["visible"] == found[1]["visible"]


def test_from_python(scene: Scene) -> None:
    gaussians, camera = random_cloud(500, 3, 60, 40)
    wanted = clsplat.render(gaussians, camera).image
    assert_same_bits(clsplat.render(gaussians, camera, max_device_mem="400KiB").image, wanted)
    with pytest.raises(CapacityError, match=r"[1-9][0-9]+ KiB to be processed at once, but 98 KiB are allowed"):
        clsplat.render(gaussians, camera, max_device_mem=100_000)
    config, plans = short(iterations=2), []
    clsplat.train(scene, config, max_device_mem="64MiB", on_plan=plans.append)
    assert [plan.allowed for plan in plans] == [64 * 2**20]


def test_a_device_with_little_memory_needs_no_flag(
    scene: Scene, default_device: Device, unlimited: tuple[bytes, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = default_device.with_memory_limit(None)
    budget = int(0.4 * unlimited[1])
    monkeypatch.setattr(Device, "budget", budget)
    assert model_bytes(scene, MANY, device, tmp_path / "run") == unlimited[0]
    assert device.memory.peak <= budget
