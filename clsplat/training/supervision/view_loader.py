# SPDX-License-Identifier: Apache-2.0
"""Inputs of a step's views: photograph, camera and background."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.config.training import TrainConfig
from clsplat.images.alpha import background_colour
from clsplat.scenes.scene import View
from clsplat.training.step.inputs import ViewInputs
from clsplat.training.step.position import Position
from clsplat.training.supervision.host_photographs import reading_threads
from clsplat.training.supervision.image_cache import ImageCache
from clsplat.training.supervision.resolution import Sizes


class ViewLoader:
    """Loader of the inputs of a step's views.

    refined: function that returns the current camera of a training view, by index.
    local: function that converts a camera from world to model coordinates.
    """

    def __init__(
        self,
        config: TrainConfig,
        views: Sequence[View],
        photographs: ImageCache,
        sizes: Sizes,
        refined: Callable[[int], Camera],
        local: Callable[[Camera], Camera],
    ) -> None:
        self._config, self._views, self._photographs, self._sizes = config, views, photographs, sizes
        self._refined, self._local = refined, local
        self._cameras: dict[int, tuple[Camera, Camera]] = {}
        self._background: Float32 = np.array(background_colour(config.background), np.float32)

    def camera(self, view: int, width: int, height: int) -> Camera:
        """Camera of a training view at the size of its photograph.

        It returns the same object while the size and the refined camera stay the same.
        """
        (of, camera), now = self._cameras.get(view, (None, None)), self._refined(view)
        if camera is None or of is not now or (camera.width, camera.height) != (width, height):
            camera = self._local(now.resized(width, height))
            self._cameras[view] = now, camera
        return camera

    def next_cameras(self, position: Position, any_size: bool) -> list[Camera]:
        """Cameras of the next step's views, the objects that `inputs` will give them, as far as they are known.

        They are other objects if the photographs' size or a refined camera changes before that step. Views of the next
        epoch are not known yet, and neither are cameras in the first epoch, because sizes are not known.

        any_size: True to return in the first epoch the scene's cameras, whose size may differ.
        """
        views = position.queue[: -1 - self._config.batch : -1]
        known = {view: self._cameras[view][1] for view in views if view in self._cameras}
        of_scene = {view: self._local(self._refined(view)) for view in views if any_size and view not in known}
        return [*(known | of_scene).values()]

    def inputs(self, view: int, position: Position, place: int, *, begins: bool) -> ViewInputs:
        """Inputs of a view, at the size of the current step.

        position: the training's position, with the step and the random generator.
        place: the view's position in the step.
        begins: True if an epoch begins with the view.
        In a batch the photograph stays on the host, because any device may take the view.
        """
        factor = self._sizes.factor(position.step)
        bring = self._photographs.bring if self._config.batch == 1 else self._photographs.load
        image = bring(view, factor)
        background = position.rng.random(3, dtype=np.float32) if self._config.random_background else self._background
        height, width = image.shape[:2]
        full = self._views[view].camera
        return ViewInputs(
            view,
            image,
            self.camera(view, width, height),
            background,
            begins,
            self._photographs.kept(view, factor),
            area=full.width * full.height / (width * height),
            place=place,
            name=self._views[view].name,
        )

    def read_ahead(self, position: Position) -> None:
        """Begin to read the photographs of the next steps, in the order of their use, until the end of the epoch."""
        batch = self._config.batch
        if self._photographs.host.has_all(self._sizes.factor(position.step)):
            return
        views = position.queue[: -1 - reading_threads() - batch : -1]
        factors = [self._sizes.factor(position.step + (1 + place // batch) * batch) for place in range(len(views))]
        self._photographs.host.read_ahead([*zip(views, factors, strict=True)])
