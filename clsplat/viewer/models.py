# SPDX-License-Identifier: Apache-2.0
"""Models that the viewer shows, from a file or in training, and the rendering of their pictures.

Only the thread that created a model may render its pictures, because a device has one command queue.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.config.presets import RASTERIZER_PRESETS
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.context import Device
from clsplat.errors import CapacityError, InputError
from clsplat.gaussians import Gaussians
from clsplat.images.colour import SRGB, displayed, photos_space
from clsplat.rendering.memory_needs import frame_pixels
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.rendering.renderer import Renderer
from clsplat.stages.device_gaussians import AnyGaussians
from clsplat.training.trainer import Trainer
from clsplat.viewer.appearance import Image, Look, alpha_picture, colour_picture, count_picture, depth_picture, edited
from clsplat.viewer.pose import MAX_PAGE_PICTURE_PIXELS

MAX_MODELS_ON_DEVICE = 2
"""Maximum number of models on the device: of the file's model and its edited copies, those shown last."""
CHANNEL_FLOATS_PER_GAUSSIAN = 3
"""Floats per Gaussian of channels other than colour. The limit of a picture's size leaves device memory for them."""


def draft(config: RasterizerConfig) -> RasterizerConfig:
    """Return rasterizer settings for pictures of a moving camera, with the approximations of the preset fast.

    SH settings are unchanged.
    """
    fast = RASTERIZER_PRESETS["fast"]
    return replace(
        config,
        alpha_min=max(config.alpha_min, fast.alpha_min),
        transmittance_min=max(config.transmittance_min, fast.transmittance_min),
    )


class HeldModel:
    """Model from a file. The device holds the model, and copies that are edited by a `Look`: the two shown last."""

    version = 0
    """Version number of the model. It is constant, as the model does not change."""

    def __init__(
        self,
        gaussians: Gaussians,
        device: Device,
        config: RasterizerConfig,
        background: Sequence[float],
        space: str = SRGB,
    ) -> None:
        """Keep the model, and prepare exact and draft rasterizers.

        space: the model's colour space (`colour.recorded_space`).
        """
        self.gaussians, self.device, self.background, self.space = gaussians, device, background, space
        self._rasterizers = {True: Rasterizer(device, config), False: Rasterizer(device, draft(config))}
        self._held: dict[Look | None, tuple[Gaussians, dict[bool, Renderer]]] = {}

    @property
    def pixels(self) -> int:
        """Maximum number of pixels of a picture on a page."""
        return min(MAX_PAGE_PICTURE_PIXELS, frame_pixels(self.device, CHANNEL_FLOATS_PER_GAUSSIAN))

    def picture(self, camera: Camera, look: Look, *, exact: bool) -> tuple[Image, str]:
        """Render a picture (H, W, 3) uint8. Returns it, and a remark for the page such as the range of depths.

        exact: False for the approximations of `draft`.
        Raises CapacityError and InputError.
        """
        key = look.changes(self.gaussians.sh_degree)
        try:
            return self._picture(key, camera, look, exact=exact)
        except CapacityError:
            self._held = {key: (self._held[key][0], {})}  # free the device memory of all other models
            return self._picture(key, camera, look, exact=exact)

    def depths(self, camera: Camera, look: Look) -> tuple[Float32, Float32]:
        """Render median depths along the camera's axis (world units) and alpha, each (H, W). Raises CapacityError."""
        renderer, gaussians = self._prepared(look.changes(self.gaussians.sh_degree), exact=True)
        return _depths(renderer, gaussians, camera)

    def _picture(self, key: Look | None, camera: Camera, look: Look, *, exact: bool) -> tuple[Image, str]:
        renderer, gaussians = self._prepared(key, exact=exact)
        return render_picture(renderer, gaussians, camera, look, self.background, self.space)

    def _prepared(self, key: Look | None, *, exact: bool) -> tuple[Renderer, Gaussians]:
        """Return a renderer, and the model with the edits `key`."""
        if key not in self._held:
            self._held[key] = (self.gaussians if key is None else edited(self.gaussians, key), {})
        gaussians, renderers = self._held.pop(key)
        while len(self._held) >= MAX_MODELS_ON_DEVICE:
            del self._held[next(iter(self._held))]
        self._held[key] = (gaussians, renderers)  # the model used most recently is last
        renderer = renderers.get(exact)
        if renderer is None:
            renderer = renderers[exact] = Renderer(self.device, self._rasterizers[exact])
        return renderer, gaussians


class LiveModel:
    """Model in training. Pictures are rendered between steps, in the trainer's memory, and do not affect training."""

    def __init__(self, trainer: Trainer, background: Sequence[float]) -> None:
        self.trainer, self.background = trainer, background
        self.space = photos_space(view.path for view in trainer.scene.views)
        self._renderer = Renderer(trainer.device, trainer.rasterizer)
        self._edited: tuple[tuple[int, Look], Gaussians] | None = None
        self._other: Renderer | None = None

    @property
    def version(self) -> int:
        """The training step, as the model's version number."""
        return self.trainer.step

    @property
    def pixels(self) -> int:
        """Maximum number of pixels of a picture: those of the largest training view, for which there is memory."""
        return max(view.camera.width * view.camera.height for view in self.trainer.views)

    def picture(self, camera: Camera, look: Look, *, exact: bool) -> tuple[Image, str]:  # noqa: ARG002  # always exact
        """Render a picture. Returns it, and a remark for the page. Raises InputError if training leaves no memory.

        exact: not used, as all pictures are exact.
        """
        trainer = self.trainer
        trainer.settle()
        degree = round(trainer.parameters.coefficients**0.5) - 1
        key = look.changes(degree)
        if key is not None or look.mode in ("depth", "count"):
            self._check_memory()
        if key is None:
            local = trainer.local(camera)
            return render_picture(self._renderer, trainer.complete_parameters, local, look, self.background, self.space)
        if self._edited is None or self._edited[0] != (trainer.step, key):
            self._edited = ((trainer.step, key), edited(trainer.gaussians(), key))
        self._other = self._other or Renderer(trainer.device, config=trainer.config.rasterizer)
        return render_picture(self._other, self._edited[1], camera, look, self.background, self.space)

    def depths(self, camera: Camera, look: Look) -> tuple[Float32, Float32]:  # noqa: ARG002  # of the whole model
        """Render depths and alpha like `HeldModel.depths`. Raises InputError if training leaves no memory."""
        trainer = self.trainer
        trainer.settle()
        self._check_memory()
        return _depths(self._renderer, trainer.complete_parameters, trainer.local(camera))

    def _check_memory(self) -> None:
        """Raise InputError if the training leaves no memory for other pictures than unedited colour and alpha."""
        if self.trainer.device.memory.limit is not None or any(self.trainer.plan.pieces):
            raise InputError("the training leaves no memory for this: only unedited colour and alpha can be shown")


Model = HeldModel | LiveModel


def _depths(renderer: Renderer, model: Gaussians | AnyGaussians, camera: Camera) -> tuple[Float32, Float32]:
    frame, channels = renderer.render_channels(model, camera, contiguous=False)
    return channels["median"], frame.alpha


def render_picture(
    renderer: Renderer,
    model: Gaussians | AnyGaussians,
    camera: Camera,
    look: Look,
    background: Sequence[float],
    space: str,
) -> tuple[Image, str]:
    """Render a picture of a model on the host or the device. Returns it, and a remark for the page.

    look: of its settings only the displayed channel is used, as the model is edited already.
    space: the model's colour space.
    """
    if isinstance(model, Gaussians) and not len(model):
        raise InputError("nothing remains of the model: the crop box contains no Gaussian")
    if look.mode in ("depth", "count"):
        frame, channels = renderer.render_channels(model, camera, background=background, contiguous=False)
        if look.mode == "depth":
            return depth_picture(channels["depth"], frame.alpha)
        return count_picture(channels["count"])
    frame = renderer.render(model, camera, background, contiguous=False)
    if look.mode == "alpha":
        return alpha_picture(frame.alpha), ""
    return colour_picture(frame.image if space == SRGB else displayed(frame.image, space)), ""
