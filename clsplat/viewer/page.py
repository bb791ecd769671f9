# SPDX-License-Identifier: Apache-2.0
"""The viewer's page in viser: controls for appearance, cameras, camera paths and screenshots. `viewer.appearance`
applies the values of the controls to the model and to the picture."""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from clsplat.arrays import Float64
from clsplat.config.pictures import DEFAULT_VIDEO_FPS
from clsplat.errors import ClsplatError, InputError, plain
from clsplat.rotations import quaternion_of
from clsplat.scenes.analysis.mask_overlay import masked
from clsplat.shots.default_orbit import parse_up
from clsplat.viewer.appearance import (
    OPACITY_FACTOR_RANGE,
    SIZE_FACTOR_RANGE,
    VIEWER_MODES,
    Image,
    Look,
    colour_picture,
    read_look,
)
from clsplat.viewer.measure import MAX_LENGTH_METRES, Measurement, point_at
from clsplat.viewer.path_recorder import add_key, path_document, save_path
from clsplat.viewer.pose import (
    MAX_PAGE_PICTURE_PIXELS,
    MAX_PAGE_SIDE_PX,
    OpeningView,
    Pose,
    fitted,
    leaning,
    wide_enough,
)
from clsplat.viewer.refinement import Level
from clsplat.viewer.scheduler import Viewing

if TYPE_CHECKING:
    from clsplat.scenes.scene import View
    from clsplat.viewer.models import Model

PAGE_PHOTO_SIDE_PX = 240
"""Maximum longer side in pixels of a photograph on the page."""
FRUSTUM_SCALE = 0.05
"""Size of a drawn camera, relative to the distance from the start position to the orbit centre."""
UP_CHOICES = ("as the scene", "y", "-y", "z", "-z", "x", "-x")
"""Choices of the page's control for the up direction."""
CAMERA_DISPLAY_CHOICES = ("hidden", "frames", "photos")
"""Choices of the page's control for drawing the scene's cameras."""
CAMERA_COLOURS = {"train": (80, 160, 255), "test": (255, 160, 60), "key": (255, 60, 90)}
"""Colours, 8-bit, of drawn cameras: of training views, of held-out views, and of a path's key frames."""
DEFAULT_PICTURE_SIZE_PX = (1280, 720)
"""Default width and height of path pictures and screenshots."""


@dataclass(frozen=True, eq=False)
class World:
    """Data of the model and its scene that all pages share.

    start: position and target of a new page's camera.
    origin: (3,), subtracted from world positions for the browser, which computes in float32.
    box: two corners (3,), the range of the crop sliders.
    degree: the model's SH degree.
    """

    title: str
    start: OpeningView
    origin: Float64
    box: tuple[Float64, Float64]
    degree: int
    views: Sequence[View] = ()


COARSE_PICTURE_REMARK = "coarse"
"""Remark on a picture that is not exact, because the camera moves or the refinement is not finished."""


class ViserPage:
    """The page of a viewer, with its controls. Methods that render are called by the thread that owns the device."""

    def __init__(self, client: Any, viewing: Viewing, world: World, paths: Path | None) -> None:
        self.client, self.viewing, self.world, self.paths = client, viewing, world, paths
        self.keys: list[Pose] = []
        self.measurement = Measurement()
        self._status: Any = None
        self._shown = 0
        self._drawing, self._drawn = 0, threading.Lock()
        self.viewer = viewing.join(self)

    def show(self, image: Image, level: Level, text: str) -> None:
        """Show a picture (H, W, 3), and as text its size, its exactness and the remark `text`.

        level: exactness of the picture, which also gives the JPEG quality.
        """
        self.client.scene.set_background_image(image, format="jpeg", jpeg_quality=level.quality)
        self._shown += 1
        if self._shown == 2:  # the controls come with the second picture, because they would delay the first
            self._build()
        height, width = image.shape[:2]
        self._say(
            ", ".join(filter(None, (f"{width} x {height}, exact" if level.exact else COARSE_PICTURE_REMARK, text)))
        )

    def tell(self, message: str) -> None:
        """Show a message, for example why there is no picture."""
        self._build()
        self.client.add_notification("clsplat", plain(message), auto_close_seconds=10.0)
        self._say(plain(message))

    def _build(self) -> None:
        """Create the controls if they do not exist yet."""
        if self._status is not None:
            return
        gui, scene = self.client.gui, self.client.scene
        for name in ("/cameras", "/keys"):
            scene.add_frame(name, show_axes=False)
        self._status = gui.add_markdown("")
        tabs = gui.add_tab_group()
        for name, add in (
            ("View", self._add_view),
            ("Path", self._add_path),
            ("Screenshot", self._add_screenshot),
            ("Measure", self._add_measure),
        ):
            with tabs.add_tab(name):
                add(gui)

    def _say(self, text: str) -> None:
        if self._status is not None and self._status.content != text:
            self._status.content = text

    def _add_view(self, gui: Any) -> None:
        mode = gui.add_dropdown("Show", VIEWER_MODES, initial_value="colour")
        degree = gui.add_slider("SH degree", 0, 3, 1, max(self.world.degree, 0))
        size = gui.add_slider("Size", *SIZE_FACTOR_RANGE, 0.05, 1.0)
        opacity = gui.add_slider("Opacity", *OPACITY_FACTOR_RANGE, 0.05, 1.0)
        low, high = self.world.box
        reach = np.maximum(high - low, 1e-6 * (float((high - low).max()) or 1.0))
        low, high = low - 0.5 * reach, high + 0.5 * reach
        with gui.add_folder("Crop", expand_by_default=False):
            crop = gui.add_checkbox("Crop", initial_value=False)
            sides = [
                gui.add_multi_slider(name, float(a), float(b), float(b - a) / 400, (float(a), float(b)))
                for name, a, b in zip("xyz", low, high, strict=True)
            ]

        async def changed(_: Any) -> None:
            box = [[side.value[0] for side in sides], [side.value[1] for side in sides]] if crop.value else None
            look = read_look(mode.value, degree.value, size.value, opacity.value, box)
            self.viewing.looks(self.viewer, look)
            self._draw_box(look)

        for control in (mode, degree, size, opacity, crop, *sides):
            control.on_update(changed)
        self._add_up(gui)
        if self.world.views:
            self._add_cameras(gui)

    def _add_up(self, gui: Any) -> None:
        up = gui.add_dropdown(
            "Up", UP_CHOICES, initial_value=UP_CHOICES[0], hint="Direction that stays up when the camera orbits."
        )
        roll = gui.add_slider("Roll", -180.0, 180.0, 1.0, 0.0, hint="Degrees clockwise about the viewing direction.")

        async def changed(_: Any) -> None:
            camera = self.client.camera
            axis = self.world.start.up if up.value == UP_CHOICES[0] else np.array(parse_up(up.value))
            if (leant := leaning(axis, camera.look_at - camera.position, roll.value)) is None:
                self.client.add_notification("clsplat", "with this up direction, the camera looks straight up or down")
            else:
                camera.up_direction = leant

        for control in (up, roll):
            control.on_update(changed)

    def _draw_box(self, look: Look) -> None:
        scene = self.client.scene
        if look.crop is None:
            scene.remove_by_name("/crop")
            return
        low, high = (np.array(corner) - self.world.origin for corner in (look.crop[:3], look.crop[3:]))
        scene.add_line_segments("/crop", edges_of(low, high), colors=CAMERA_COLOURS["key"])

    def _add_cameras(self, gui: Any) -> None:
        shown = gui.add_dropdown(
            "Cameras",
            CAMERA_DISPLAY_CHOICES,
            initial_value=CAMERA_DISPLAY_CHOICES[0],
            hint="Blue: training; orange: held out. Click a camera to look through it.",
        )

        def changed(_: Any) -> None:  # runs in a thread of viser, since photographs take time to read
            self._drawing += 1
            mine = self._drawing
            with self._drawn:  # only the latest request draws all cameras; earlier ones stop
                if mine == self._drawing:
                    self._clear("/cameras")
                for index, view in enumerate(self.world.views):
                    if mine != self._drawing or shown.value == CAMERA_DISPLAY_CHOICES[0]:
                        return
                    self._add_camera(index, view, photo=shown.value == CAMERA_DISPLAY_CHOICES[2])

        shown.on_update(changed)

    def _clear(self, name: str) -> None:
        """Remove everything below this name from the browser's scene."""
        with self.client.atomic():
            self.client.scene.remove_by_name(name)
            self.client.scene.add_frame(name, show_axes=False)

    def _add_camera(self, index: int, view: View, *, photo: bool) -> None:
        camera = view.camera
        if not camera.is_pinhole:
            return
        fov, aspect = (
            2 * math.atan2(0.5 * camera.height, camera.fy),
            camera.width / camera.fx * camera.fy / camera.height,
        )
        pose = Pose(camera.rotation.T, camera.position, fov, camera.width, camera.height)
        image = thumbnail(view) if photo else None
        handle = self._add_frustum(
            f"/cameras/{index}", pose, view.split, image=image, cast_shadow=False, receive_shadow=False
        )

        async def clicked(_: Any) -> None:
            viewpoint = self.client.camera
            ahead = float(np.linalg.norm(viewpoint.look_at - viewpoint.position))
            with self.client.atomic():
                viewpoint.position = camera.position - self.world.origin
                viewpoint.look_at = camera.position - self.world.origin + ahead * camera.rotation[2]
                viewpoint.fov = wide_enough(fov, aspect, viewpoint.image_width, viewpoint.image_height)

        handle.on_click(clicked)

    def _add_path(self, gui: Any) -> None:
        def button(name: str, action: Callable[[], None]) -> None:
            async def clicked(_: Any) -> None:
                self._attempt(action)
                keys = len(self.keys)
                count.content = f"{keys or 'no'} key{'' if keys == 1 else 's'}"

            gui.add_button(name).on_click(clicked)

        def add() -> None:
            if (pose := self.viewer.pose) is not None:
                add_key(self.keys, pose)
                # thin lines, because they cover the page's edges as long as the camera stays at this pose
                name = f"/keys/{len(self.keys) - 1}"
                self._add_frustum(name, pose, "key", thickness=2.0, thickness_units="screen")

        def remove() -> None:
            del self.keys[-1:]
            self.client.scene.remove_by_name(f"/keys/{len(self.keys)}")

        def clear() -> None:
            self.keys.clear()
            self._clear("/keys")

        def document() -> str:
            size = (int(width.value), int(height.value))
            return path_document(self.keys, size, apart=float(apart.value), fps=float(fps.value), loop=loop.value)

        def download() -> None:
            self.client.send_file_download("path.json", document().encode(), save_immediately=True)

        button("Add key", add)
        button("Remove last key", remove)
        button("Clear keys", clear)
        count = gui.add_markdown("no keys")
        apart = gui.add_number("Seconds between keys", 2.0, min=0.05, max=3600.0, step=0.05)
        fps = gui.add_number("Frames per second", DEFAULT_VIDEO_FPS, min=1.0, max=240.0, step=1.0)
        loop = gui.add_checkbox("Closed loop", initial_value=False)
        width, height = self._add_size(gui)
        button("Download path", download)
        if (folder := self.paths) is not None:
            button("Save path", lambda: self.tell(f"saved as {save_path(folder, document()).name}"))

    def _add_frustum(self, name: str, pose: Pose, kind: str, **options: Any) -> Any:
        """Draw a camera as the node `name` of the browser's scene. kind: key of CAMERA_COLOURS. options: viser's."""
        start = self.world.start
        return self.client.scene.add_camera_frustum(
            name,
            pose.fov,
            pose.width / pose.height,
            scale=FRUSTUM_SCALE * float(np.linalg.norm(start.position - start.target)),
            color=CAMERA_COLOURS[kind],
            wxyz=quaternion_of(pose.rotation),
            position=pose.position - self.world.origin,
            **options,
        )

    def _add_screenshot(self, gui: Any) -> None:
        width, height = self._add_size(gui)
        take = gui.add_button("Take screenshot")

        async def taken(_: Any) -> None:
            size = (int(width.value), int(height.value))
            self.viewing.ask(self.viewer, lambda model: self.screenshot(model, size))

        take.on_click(taken)

    def _add_measure(self, gui: Any) -> None:
        pick = gui.add_button("Pick two points")
        metres = gui.add_number("Length in metres", 0.0, min=0.0, max=MAX_LENGTH_METRES, step=0.001)
        result = gui.add_markdown("")

        def show() -> None:
            result.content = self.measurement.text(float(metres.value))

        async def begun(_: Any) -> None:
            self.measurement.points = []
            self.client.scene.remove_by_name("/measure")
            show()
            if not pick.disabled:
                pick.disabled = True  # until two points are clicked
                self.client.scene.on_click()(clicked)

        async def clicked(event: Any) -> None:
            place = float(event.screen_pos[0]), float(event.screen_pos[1])
            self.viewing.ask(self.viewer, lambda model: measured(model, place))

        def measured(model: Model, place: tuple[float, float]) -> None:
            if (pose := self.viewer.pose) is None:
                return
            camera = pose.camera().resized(*fitted(pose.width, pose.height, 1.0, model.pixels))
            self.measurement.add(point_at(camera, *model.depths(camera, self.viewer.look), place))
            self._draw_measure()
            if len(self.measurement.points) == 2:
                self.client.scene.remove_click_callback(clicked)
                pick.disabled = False
            show()

        async def changed(_: Any) -> None:
            show()

        pick.on_click(begun)
        metres.on_update(changed)

    def _draw_measure(self) -> None:
        points = np.stack(self.measurement.points) - self.world.origin
        self.client.scene.add_line_segments("/measure", points[[[0, -1]]], colors=CAMERA_COLOURS["key"], line_width=3.0)

    def _add_size(self, gui: Any) -> tuple[Any, Any]:
        def add_side(name: str, usual: int) -> Any:
            return gui.add_number(name, usual, min=1, max=MAX_PAGE_SIDE_PX, step=1)

        return add_side("Width", DEFAULT_PICTURE_SIZE_PX[0]), add_side("Height", DEFAULT_PICTURE_SIZE_PX[1])

    def screenshot(self, model: Model, size: tuple[int, int]) -> None:
        """Render an exact picture, with the bits of `clsplat render`, and send it to the browser as a file.

        size: width and height in pixels.
        Raises InputError for a size out of range.
        """
        pose = self.viewer.pose
        if pose is None:
            return
        width, height = size
        if not (
            1 <= width <= MAX_PAGE_SIDE_PX
            and 1 <= height <= MAX_PAGE_SIDE_PX
            and width * height <= 4 * MAX_PAGE_PICTURE_PIXELS
        ):
            raise InputError(
                f"the screenshot would have {width}x{height} pixels, expected 1 to {MAX_PAGE_SIDE_PX:,} on a side and "
                f"at most {4 * MAX_PAGE_PICTURE_PIXELS:,} in all"
            )
        image, _ = model.picture(pose.camera(width, height), self.viewer.look, exact=True)
        self.client.send_file_download("screenshot.png", png(image), save_immediately=True)

    def _attempt(self, action: Callable[[], None]) -> None:
        """Run an action and show its error as a message."""
        try:
            action()
        except ClsplatError as error:
            self.tell(str(error))
        except OSError as error:
            self.tell(re.sub(r": '.*'$", "", str(error)))  # do not show paths of this machine to a browser


def png(image: Image) -> bytes:
    """Encode an image as PNG."""
    import imageio.v3 as iio

    return iio.imwrite("<bytes>", image, extension=".png")


@cache
def thumbnail(view: View) -> Image | None:
    """Draw a small picture (H, W, 3) of a photograph, with masked areas in red and blue.

    The result is None if the file cannot be read.
    """
    camera = view.camera
    scale = min(PAGE_PHOTO_SIDE_PX / max(camera.width, camera.height), 1.0)
    try:
        picture = masked(view, max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    except (ClsplatError, OSError):
        return None
    return colour_picture(picture.drawn())


def edges_of(low: Any, high: Any) -> Any:
    """Return the end points of the twelve edges of a box, (12, 2, 3) float32. low, high: its corners (3,)."""
    corners = np.array([[(low, high)[bit][axis] for axis, bit in enumerate(bits)] for bits in np.ndindex(2, 2, 2)])
    pairs = [(a, b) for a in range(8) for b in range(a) if (a ^ b).bit_count() == 1]
    return corners[np.array(pairs)].astype(np.float32)
