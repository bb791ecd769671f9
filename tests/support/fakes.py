# SPDX-License-Identifier: Apache-2.0
"""Fakes of scene, device, trainer, renderer and image files, for tests of the command line alone."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from models import random_gaussians

from clsplat.camera import Camera
from clsplat.cli import main as command_line
from clsplat.cli.session import Services
from clsplat.config.depth import NO_DEPTH, DepthUse
from clsplat.config.masks import NO_MASKS, MaskUse
from clsplat.config.orientation import AS_IN_FILES
from clsplat.config.points import StartPoints
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.config.training import TrainConfig
from clsplat.errors import DeviceError, InputError
from clsplat.gaussians import Gaussians
from clsplat.images import frame_files as layers
from clsplat.runs.run import Run
from clsplat.scenes.dataset import SOURCE_FRAME
from clsplat.sequence.frame_renderer import FrameRenderer
from clsplat.sequence.task import RenderOptions
from clsplat.shots import read
from clsplat.training.start import NO_START, Start


def camera(width: int = 32, height: int = 24) -> Camera:
    return Camera(width, height, 30.0, 31.0, width / 2, height / 2, np.eye(3), np.zeros(3))


@dataclass
class FakeView:
    name: str
    split: str
    camera: Camera = field(default_factory=camera)

    def load(self, width: int | None = None, height: int | None = None) -> np.ndarray:
        return np.full((height or self.camera.height, width or self.camera.width, 3), 0.5, np.float32)

    load_masked = load


@dataclass
class FakeDevice:
    name: str = "processor"
    driver: str = "OpenCL 3.0 driver 1.0"
    profile: bool = False
    budget: int = 1 << 30
    max_allocation: int = 1 << 28


@dataclass
class Pipeline:
    """Fakes for a call of the command line (`main`).

    calls: calls of the fakes, in order.
    written: pixels of the written files, by path.
    cameras: cameras that a camera file has, by name.
    training: called by the fake training with the run and `on_step`.
    """

    calls: list[tuple[Any, ...]] = field(default_factory=list)
    written: dict[str, np.ndarray] = field(default_factory=dict)
    cameras: dict[str, Camera] = field(default_factory=lambda: {"a.jpg": camera(), "sub/b.c.jpg": camera(20, 40)})
    training: Callable[..., None] = lambda *_: None
    services: Services = field(default_factory=Services)

    def main(self, arguments: list[str]) -> int:
        return command_line.main(arguments, self.services)

    def write_channels(self, path: Path, made: dict[str, np.ndarray], *_: object) -> None:
        """Replacement of `frame_files.write_channels`, which keeps the planes in `written`."""
        planes = [plane if plane.ndim == 3 else plane[:, :, None] for plane in made.values()]
        self.written[str(path)] = np.concatenate(planes, axis=2)


@pytest.fixture
def pipeline(monkeypatch: pytest.MonkeyPatch) -> Pipeline:
    """Fakes of scene, device, trainer, renderer and image files."""
    pipe = Pipeline()

    @dataclass
    class Scene:
        views: list[FakeView]
        warnings: list[str]
        name: str = "photos"
        points: tuple[float, ...] = ()
        start: StartPoints = TrainConfig().start_points
        depth_use: DepthUse = NO_DEPTH
        unit: float = 1.0
        extent = 1.0
        unit_differs = False
        frame = SOURCE_FRAME

        @property
        def train_views(self) -> list[FakeView]:
            return [view for view in self.views if view.split == "train"]

        @property
        def sampled_views(self) -> list[FakeView]:
            return self.views

        @property
        def test_views(self) -> list[FakeView]:
            return [view for view in self.views if view.split == "test"]

        def require_training_views(self) -> list[FakeView]:
            return self.train_views

        def check_pictures(self) -> None:
            """Accept the pictures. test_scene.py tests damaged ones."""

    @dataclass
    class Result:
        image: np.ndarray
        alpha: np.ndarray

    @dataclass
    class Report:
        step: int
        loss: float = 0.1
        psnr: float = 20.0
        gaussians: int = 4
        seconds: float = 1.0

    class Renderer:
        def __init__(self, device: object, config: object = None) -> None:
            assert isinstance(device, FakeDevice)
            assert config == RasterizerConfig()
            self.device = device

        def render(
            self, gaussians: Gaussians, camera: Camera, background: tuple[float, ...] = (0, 0, 0), **_: Any
        ) -> Result:
            pipe.calls.append(("render", len(gaussians), camera.width, camera.height, tuple(background)))
            size = (camera.height, camera.width)
            return Result(np.full((*size, 3), 0.25, np.float32), np.full(size, 0.5, np.float32))

    def load_scene(
        config: TrainConfig,
        path: Path,
        *,
        masks: MaskUse | None = None,
        frame: object,
        frames: int | None = None,
        progress: Callable[..., None],
    ) -> Any:
        assert (masks or config.mask_use, config.lenses, config.missing) == (NO_MASKS, "undistort", "few")
        assert frames is None
        assert frame in (AS_IN_FILES, SOURCE_FRAME), "the run has no frame.json"
        if not Path(path).is_dir():
            raise InputError(f"{path}: no such folder")
        pipe.calls.append(("load_scene", str(path), config.resolution, config.test_every))
        views = [FakeView("0.jpg", "test"), FakeView("1.jpg", "train")]
        return Scene(views if config.test_every else views[1:], ["one photo is dark"])

    def train(
        scene: Scene,
        config: TrainConfig,
        *,
        device: FakeDevice,
        max_host_mem: str | None,
        cache: str | None,
        scratch: str | None,
        run: Run,
        resume: bool,
        start: Start,
        on_step: Any,
        on_plan: Any,
        between: Any = None,
    ) -> Gaussians:
        assert start == NO_START
        pipe.calls.append(("train", config.iterations, config.seed, resume))
        on_step(Report(1))
        pipe.training(run, on_step)
        gaussians = random_gaussians(4)
        run.save_model(gaussians)
        run.append_metrics({"step": config.iterations, "loss": 0.1, "gaussians": 4, "seconds": 2.5})
        run.write_eval({"step": 1, "gaussians": 4, "seconds": 2.5, "mean": {"psnr": 20.0, "ssim": 0.5}, "views": [{}]})
        return gaussians

    def open_device(selector: str | None, memory_limit: int | None = None) -> Any:
        if selector == "nosuch":
            raise DeviceError("--device nosuch: no such device")
        return FakeDevice()

    def open_frame_renderer(
        gaussians: Gaussians, options: RenderOptions, rasterizer: RasterizerConfig, *, device: str | None, **_: Any
    ) -> FrameRenderer:
        return FrameRenderer(Renderer(open_device(device), rasterizer), gaussians, options)

    renderer: Callable[..., Any] = Renderer
    monkeypatch.setattr(read, "read_cameras", lambda *_: pipe.cameras)
    monkeypatch.setattr(layers, "write_channels", pipe.write_channels)
    pipe.services = replace(
        pipe.services,
        load_scene=load_scene,
        findings=lambda *_: [],
        open_device=open_device,
        require=lambda device, *_: device,
        train=train,
        renderer=renderer,
        open_frame_renderer=open_frame_renderer,
    )
    return pipe


@pytest.fixture
def folder(tmp_path: Path) -> str:
    (tmp_path / "folder").mkdir()
    return str(tmp_path / "folder")


@pytest.fixture
def model(tmp_path: Path) -> str:
    path = tmp_path / "some.ply"
    random_gaussians(4).save(path)
    return str(path)
