# SPDX-License-Identifier: Apache-2.0
"""Flags of `clsplat render`."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from clsplat.cli.options import Flag, Memory, OptionalInt, RunOrModel, Verb, with_given
from clsplat.cli.render.help_page import RENDER_GROUPS
from clsplat.config.channels import in_words
from clsplat.config.pictures import (
    DEFAULT_EXR_DEPTH,
    VIDEO_SUFFIXES,
    ColourConfig,
    Compression,
    DeepConfig,
    ExrDepth,
    FramingConfig,
    HoldoutConfig,
    Parts,
    SamplingConfig,
    VideoConfig,
    WarpConfig,
)
from clsplat.config.presets import RASTERIZER_PRESETS, Preset
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.config.stereo import StereoConfig
from clsplat.config.training import Lenses
from clsplat.errors import InputError

_CHANNELS_HELP = (
    f"Channels of the files: {in_words('image')}. EXR files can also hold {in_words('features', 'depths')}. Further "
    f"EXR channels are {in_words('whole')}, {in_words('shares')}. docs/render.md describes each."
)


@dataclass(frozen=True)
class RenderVerb(Verb):
    """Render a model from the cameras of a file or along a path made from them, an image for each frame."""

    groups = RENDER_GROUPS
    model: RunOrModel
    """A run's folder or a model file. A model that changes has a file for each frame ('capture.####.ply'). A shot with
    several models is a .json file or a USD stage that places them (docs/shot.md)."""
    output: Annotated[str, arg(aliases=("-o",), metavar="PATTERN")]
    """File names of the images, such as 'out/{name}.png' or 'shot/beauty.####.exr': EXR, PNG, TIFF, JPEG or DPX. A
    name such as turn.mp4, or turn.mov for ProRes, makes a video of all frames. {name} is the image's name without its
    extension but with its sub-folders, or else the frame's number. ####, %04d and {frame} are the frame's number;
    {eye} and %V are left or right."""
    cameras: Annotated[Path | None, arg(metavar="PATH")] = None
    """Folder of a COLMAP model (cameras and images, bin or txt), or of a scene that contains one. Or a file:
    transforms.json, cameras of a survey, nerfstudio's camera_path.json, cameras.json of 3DGS, a clsplat camera file
    (.json) or a USD stage. docs/cameras.md describes each. Not needed with --path turntable or spiral."""
    transform: Annotated[str | None, arg(metavar="FILE|STEPS|M00,M01,...")] = None
    """Place the model by a 4 x 4 matrix: rotation, uniform scale, translation. Give 16 numbers row by row, a file of
    them, or steps in their order such as 'rotate=0,90,0 scale=2 translate=1,0,0'. A JSON file can hold key frames or a
    matrix for each frame (docs/shot.md)."""
    path: Annotated[Literal["turntable", "spiral", "through"] | None, arg(metavar="turntable|spiral|through")] = None
    """Path made from the cameras, instead of the cameras themselves. turntable: once around the point that they
    look at; spiral: twice around it, rising and sinking; through: along the cameras in their order, smoothed. Frames
    count from 1. Without --cameras, the path is made from the cameras of a run's photographs. For a model file it goes
    around the whole model if that is an object, or around the most detailed part of a scene."""
    up: Annotated[str | None, arg(metavar="AXIS|X,Y,Z")] = None
    """Up direction of a path around a model, without --cameras: x, y, z, -x, -y, -z or three numbers. If not given: -y,
    as in a COLMAP scene. With --up, the path goes around a run's model too. Write --up=-z if the value begins with a
    minus."""
    count: OptionalInt = None
    """Number of frames of the path; 120 if not given."""
    frames: Annotated[str | None, arg(metavar="1-100,200-300:2,...")] = None
    """Render only these frames; all if not given. Ranges may have a step. Write --frames=-5-10 if the first number is
    negative."""
    usd_camera: Annotated[str | None, arg(metavar="PRIM")] = None
    """Path or name of the camera, for a USD stage with several cameras."""
    lenses: Annotated[Lenses | None, arg(metavar="undistort|native")] = None
    """Rendering of fisheye cameras of photographs. undistort: as the pinhole cameras that fit into them; native:
    through their own lens. If not given: as the run was trained. With --path, whose cameras are pinholes, and for a
    model without a run: undistort."""
    channels: Annotated[str, arg(metavar="NAME,...", help=_CHANNELS_HELP)] = "rgb"
    ids_from: Annotated[str | None, arg(metavar="PROPERTY")] = None
    """Property of the models' PLY files that holds an integer id for each Gaussian, for --channels semantic."""
    background: Annotated[str | None, arg(metavar="black|white|R,G,B")] = None
    """Colour behind the Gaussians: black, white or three numbers from 0 to 1; black if not given."""
    appearance: Annotated[str | None, arg(metavar="PHOTO")] = None
    """Give the model the exposure and colours of this photograph of its scene, from the run's appearance.json, but not
    its lens's vignette. If not given: the photographs' average. The background does not change."""
    alpha: Flag = False
    """Write alpha too, like --channels rgb,alpha, without a background. It is premultiplied in EXR and TIFF, straight
    in PNG."""
    exr: ExrDepth = DEFAULT_EXR_DEPTH
    """Type of colour, alpha and normals in EXR files: half (16 bits) or float (32 bits). Depths, positions and motion
    are always float."""
    parts: Parts = "one"
    """one: all channels of an EXR file in one part; several: one part for colour with alpha, and one for each other
    channel."""
    compression: Compression = "zip"
    """Compression of EXR files. pxr24, dwaa and dwab change the values slightly. The others are lossless."""
    bits: Annotated[Literal[8, 10, 16] | None, arg(metavar="8|10|16")] = None
    """Bits of each channel: 8 or 16 in PNG and TIFF files, 8 if not given; 10 or 16 in DPX files, 10 if not given."""
    quality: int = 95
    """Quality of JPEG files, from 1 to 100 (best)."""
    width: OptionalInt = None
    """Width in pixels. If not given: follows from --height, else the camera's width. If width and height change the
    camera's shape, its vertical field of view is kept."""
    height: OptionalInt = None
    """Height in pixels. If not given: follows from --width, else the camera's height."""
    scale: float = 1.0
    """Factor on the camera's width and height, such as 0.5. It excludes --width and --height."""
    colour: Annotated[ColourConfig, arg(name="")] = field(default_factory=ColourConfig)
    framing: Annotated[FramingConfig, arg(name="")] = field(default_factory=FramingConfig)
    sampling: Annotated[SamplingConfig, arg(name="")] = field(default_factory=SamplingConfig)
    warp: Annotated[WarpConfig, arg(name="")] = field(default_factory=WarpConfig)
    pairs: Annotated[StereoConfig, arg(name="")] = field(default_factory=StereoConfig)
    deep: Flag = False
    """Write deep EXR: colour, alpha and depth of each pixel, in slices by depth. docs/pictures.md explains them."""
    slices: Annotated[DeepConfig, arg(name="deep")] = field(default_factory=DeepConfig)
    holdout: Annotated[str | None, arg(metavar="PATTERN")] = None
    """Depth EXR or deep EXR of other elements, such as 'cg/depth.####.exr'. Everything behind their surfaces is left
    out of all channels. docs/pictures.md explains holdouts."""
    holding: Annotated[HoldoutConfig, arg(name="holdout")] = field(default_factory=HoldoutConfig)
    video: VideoConfig = field(default_factory=VideoConfig)
    preset: Annotated[Preset | None, arg(metavar="exact|default|fast")] = None
    """Bundle of rasterizer settings: exact and default approximate nothing, fast approximates a little. A --rasterizer
    flag overrides it. If not given: the run's own settings, else default."""
    overwrite: Flag = False
    """Replace an existing video, and pictures that clsplat did not make. Frames that clsplat made are replaced
    without this flag, unless --skip-existing is given."""
    skip_existing: Flag = False
    """Leave out frames with an intact file of the same size, channels and model. If the file records its cameras and
    settings, these must agree too."""
    dry_run: Flag = False
    """Print the plan and render nothing: frames, sizes, channels, memory, files."""
    progress: Literal["auto", "json", "openjd", "none"] = "auto"
    """auto: a bar on a terminal, and a line for each frame written. json: one object a line for each frame, on standard
    output, or on standard error with --json. openjd: progress messages for Open Job Description."""
    profile: Flag = False
    """Measure the fraction of time in which the device works. With --json, also report the device's time
    for each frame."""
    device: Annotated[str | None, arg(metavar="DEVICE,...|all")] = None
    """OpenCL device: an index, cpu, gpu, or part of a name, as listed by `clsplat devices`. Several, separated by
    commas, share the frames. If not given: CLSPLAT_DEVICE, else the first GPU, else the first device."""
    workers: OptionalInt = None
    """Render in this many processes on this machine, as a Dask cluster. Needs the extra: pip install
    'clsplat[farm]'."""
    scheduler: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """Render on the Dask cluster of the scheduler at this address, such as tcp://host:8786. Its workers need the model
    and the output folder under the same paths."""
    max_device_mem: Memory = None
    """Limit of device memory, such as 256MiB or 2G. Work that needs more is done in pieces: slower, with the same
    result. If not given: all of the device's memory."""
    json: Flag = False
    """Print the frames as JSON when all are done: name, frame, path, width, height, seconds, skipped, and blank (no
    part of the model is visible). With --dry-run: the plan."""
    rasterizer: RasterizerConfig = field(default_factory=RasterizerConfig)

    def completed(self, given: Collection[str]) -> RenderVerb:
        """Return the arguments with the rasterizer's settings of --preset, or else of the run, and the run's lenses.

        Flags that are `given` override these. Raises InputError.
        """
        from clsplat.models.formats import model_path
        from clsplat.runs.run import Run, is_run

        if "lenses" in given and self.cameras is None:
            raise InputError(f"--lenses {self.lenses}: is for cameras of photographs, expected --cameras with it")
        if self.lenses is not None and self.warp.distort:
            raise InputError(f"--lenses {self.lenses} and --distort exclude each other: --distort applies the lens")
        bundle, lenses = RASTERIZER_PRESETS["default"], self.lenses or "undistort"
        if self.model.is_dir() and (is_run(self.model) or model_path(self.model) == self.model):
            config = Run.open(self.model).config  # refuse a folder that is neither a run nor a model
            bundle, lenses = config.rasterizer, self.lenses or ("undistort" if self.path else config.lenses)
        if self.preset is not None:
            bundle = RASTERIZER_PRESETS[self.preset]
        return replace(self, rasterizer=with_given(bundle, self.rasterizer, given, "rasterizer."), lenses=lenses)

    @property
    def is_video(self) -> bool:
        """True if the output is a video, one file with all frames."""
        return self.extension in VIDEO_SUFFIXES

    @property
    def extension(self) -> str:
        """Ending of the file names, in lower case."""
        return Path(self.output).suffix.lower()

    @property
    def on_farm(self) -> bool:
        """True if other processes render: workers on this machine, or a Dask cluster."""
        return self.workers is not None or self.scheduler is not None
