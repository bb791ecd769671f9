# SPDX-License-Identifier: Apache-2.0
"""Pictures of a capture's model: a thumbnail, and a turntable as a sequence of images and as a video."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from clsplat.arrays import Float32, Float64
from clsplat.camera import Camera
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.images.reading import read_image
from clsplat.images.video import frame_planes, video_missing, video_writer
from clsplat.images.writing import write_image
from clsplat.progress import Progress, no_progress
from clsplat.rendering.renderer import Renderer
from clsplat.runs.run import Run
from clsplat.shots.generated import turntable

CAPTURE_THUMBNAIL_SIDE_PX = 512
"""Width and height of a capture's thumbnail in pixels."""
TURNTABLE_VIDEO_FILE = "turntable.mp4"
"""Video of the turntable, in the folder of its frames."""


class ModelPictures:
    """Pictures of a run's model, from a turntable: a path around the point that the photographs' cameras look at.

    cameras: cameras of the photographs.
    frames: number of frames of the turntable.
    up: up direction (3,) of an upright scene; None to estimate it from the cameras.
    """

    def __init__(
        self, run: Run, device: Device, cameras: Sequence[Camera], frames: int, up: Float64 | None = None
    ) -> None:
        self._renderer = Renderer(device, config=run.config.rasterizer)
        self._model = Gaussians.load(run.model_path)
        self.path = turntable(cameras, frames, up)

    def _drawn(self, camera: Camera) -> Float32:
        """Render the model on a black background, (H, W, 3)."""
        return self._renderer.render(self._model, camera, (0.0, 0.0, 0.0)).image

    def write_thumbnail(self, path: Path) -> None:
        """Write the first picture of the turntable as a small square PNG."""
        write_image(path, self._drawn(self.path[0].reshaped(CAPTURE_THUMBNAIL_SIDE_PX, CAPTURE_THUMBNAIL_SIDE_PX)))

    def write_turntable(self, folder: Path, progress: Progress = no_progress) -> Path | None:
        """Write the turntable's frames and, if PyAV is installed, its video. Returns the video's path, or None.

        Existing frames are kept. If the video is missing or a frame was rendered, the video is encoded again.
        """
        folder.mkdir(exist_ok=True)
        video = None if video_missing() else folder / TURNTABLE_VIDEO_FILE
        files = [folder / f"frame_{index:03d}.png" for index in range(len(self.path))]
        if all(file.is_file() for file in files) and (video is None or video.is_file()):
            progress("using the turntable rendered before", 1.0)
            return video
        for index, (file, camera) in enumerate(zip(files, self.path, strict=True)):
            if not file.is_file():
                write_image(file, self._drawn(camera))
            progress("rendering the turntable", (index + 1) / len(files))
        if video is not None:
            progress("encoding the turntable's video", None)
            with video_writer(video) as writer:
                for file in files:  # from the files, so that the video has the same bytes after an interruption
                    writer.add(frame_planes(read_image(file)))
        return video
