# SPDX-License-Identifier: Apache-2.0
"""The command line: what each verb takes. What it does is in `clsplat.cli.verbs`, the training's defaults in `config`.

Exit status: 0 done, 1 the work failed, 2 the call or its input is wrong, 130 interrupted, 128 and the signal's number
where another one did that (docs/interruptions.md). Trouble is one line on standard error; CLSPLAT_DEBUG=1 shows the
traceback as well.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
import traceback
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, cast, get_args, get_origin

import tyro
from tyro.conf import Positional, arg, subcommand

from clsplat.cli.options import Compare, Convert, Device, Flag, Folder, Host, Info, Memory, Report, View
from clsplat.config.pictures import (
    EXR_DEPTH,
    ColourConfig,
    Compression,
    DeepConfig,
    ExrDepth,
    FramingConfig,
    Parts,
    SamplingConfig,
    VideoConfig,
)
from clsplat.config.presets import PRESETS, Preset, Schedule, bundled
from clsplat.config.rasterizer import BenchSwitches, RasterizerConfig
from clsplat.config.training import TrainConfig
from clsplat.config.verbs import DEMO_ITERATIONS, HOST, PORT
from clsplat.errors import ClsplatError, InputError, switched_on, system_trouble
from clsplat.process import reader_has_gone, status_of, terminable

Output = Annotated[Path, arg(aliases=("-o",), metavar="DIR")]


@dataclass(frozen=True)
class Devices:
    """List the OpenCL devices."""

    device: Device = None
    """List only the one that this names, as other verbs' --device does: an index, cpu, gpu, or a part of a name.
    If not given: all of them."""
    json: Flag = False
    """Print a JSON array instead of the table."""


@dataclass(frozen=True)
class Demo:
    """Make photographs of a small scene, recover their cameras, train, evaluate and render a turntable."""

    output: Output
    """Folder for everything the demo makes: a new one, or one that a demo has made, which is made anew."""
    iterations: int = DEMO_ITERATIONS
    """Training steps. A few hundred show that all works, and less of the scene."""
    device: Device = None
    """OpenCL device: an index, cpu, gpu, or a part of a name, as `clsplat devices` lists them.
    If not given: CLSPLAT_DEVICE, else the first GPU, else the first device."""
    json: Flag = False
    """Print the evaluation as JSON on standard output."""


@dataclass(frozen=True)
class Sfm:
    """Turn a folder of photos into a scene: COLMAP's cameras and points, and the undistorted images."""

    photos: Annotated[Positional[Path], arg(metavar="PHOTOS")]
    """Folder with the photos; sub-folders are searched too."""
    output: Output
    """Folder for the scene."""
    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Match every pair of photos, or only neighbours by name, for video frames; auto: every pair up to 100 photos."""
    camera_model: Annotated[str, arg(metavar="MODEL")] = "auto"
    """Lens model to fit, by COLMAP's name; the scene's images are undistorted with it.
    auto is OPENCV for a camera with 20 photos or more, else SIMPLE_RADIAL."""
    threads: Annotated[int | None, arg(metavar="INT")] = None
    """Number of CPU threads; if not given, one for each core."""
    seed: int = 0
    """Seed of what is random in matching and reconstruction. The same seed gives the same cameras, for up to 80
    photos."""
    overwrite: Flag = False
    """Replace a scene in the output folder that was made of other photos or with other settings."""
    json: Flag = False
    """Print what was recovered as JSON, as in the scene's sfm.json."""


@dataclass(frozen=True)
class Train:
    """Train a scene. Ctrl-C, SIGTERM and SIGHUP write a checkpoint first; --resume goes on from the latest.

    With --resume the settings of the run hold, and a flag that is given changes one.
    """

    output: Output
    """Folder for the run: config.toml, scene.json, model.ply, metrics.jsonl, eval.json, report.html, checkpoints/,
    test/."""
    scene: Annotated[Positional[Path | None], arg(metavar="SCENE")] = None
    """Folder with the scene: COLMAP, Blender, nerfstudio, instant-ngp, or just photos. Not needed with --resume."""
    resume: Flag = False
    """Go on with the run in the output folder."""
    accept_changes: Flag = False
    """With --resume: go on though the scene is another than the run began with, or a photograph has changed."""
    overwrite: Flag = False
    """Replace the run in the output folder; files that clsplat did not write stay."""
    device: Device = None
    """OpenCL device: an index, cpu, gpu, or a part of a name, as `clsplat devices` lists them.
    If not given: CLSPLAT_DEVICE, else the first GPU, else the first device."""
    max_device_mem: Memory = None
    """Most device memory to use, such as 256MiB or 2G. What needs more is done in pieces: slower, with the same result.
    If not given: all that the device has."""
    view: Flag = False
    """Show the model as it grows on a page in the browser, where training can be paused too (see clsplat view)."""
    host: Host = HOST
    """Address that the page is served at: this machine alone, unless another is given."""
    port: int = PORT
    """Port of the page; 0 is any that is free."""
    paths: Folder = None
    """Folder in which the page may save camera paths; they can be downloaded without it."""
    json: Flag = False
    """Print the final evaluation as JSON on standard output."""
    preset: Preset = "default"
    """Bundle of settings. exact and default approximate nothing and are the same; fast takes less than half of the
    time, and lost at most 0.3 dB of PSNR on the scenes it was made on. Flags that are given override it."""
    schedule: Schedule | None = None
    """Bundle of learning rates and of the steps at which things happen: paper, made for 30,000 steps; short, for
    --iterations of about 7000. Flags that are given override it. If not given: paper, but short with --preset fast."""
    config: Annotated[TrainConfig, arg(name="")] = field(default_factory=TrainConfig)


@dataclass(frozen=True)
class Eval:
    """Measure a model on a scene's held-out views: PSNR, SSIM, and LPIPS where the extra is installed.

    Given a run, eval.json and test/ are written anew.
    """

    model: Annotated[Positional[Path], arg(metavar="RUN|MODEL")]
    """A run's folder or a model file; for a file in a run's folder that run's settings hold."""
    scene: Annotated[Path | None, arg(metavar="SCENE")] = None
    """Folder with the scene; the one the run was trained on if not given."""
    test_every: Annotated[int | None, arg(metavar="INT")] = None
    """Every n-th view by name is held out, and measured. If not given: the run's setting, else 8."""
    resolution: Annotated[int | None, arg(metavar="INT")] = None
    """Longest image side in pixels; 0 keeps the images' size up to 1600. If not given: the run's setting, else 0."""
    background: Annotated[Literal["black", "white"] | None, arg(metavar="black|white")] = None
    """Background behind the Gaussians and behind images with alpha. If not given: the run's setting, else black."""
    device: Device = None
    """OpenCL device: an index, cpu, gpu, or a part of a name, as `clsplat devices` lists them.
    If not given: CLSPLAT_DEVICE, else the first GPU, else the first device."""
    max_device_mem: Memory = None
    """Most device memory to use, such as 256MiB or 2G. What needs more is done in pieces: slower, with the same result.
    If not given: all that the device has."""
    json: Flag = False
    """Print the result as JSON, as in eval.json."""


@dataclass(frozen=True)
class Render:
    """Render a model from the cameras of a file or along a path made from them, an image for each frame."""

    model: Annotated[Positional[Path], arg(metavar="RUN|MODEL")]
    """A run's folder or a model file."""
    cameras: Annotated[Path, arg(metavar="PATH")]
    """Folder of a COLMAP model (cameras and images, bin or txt), or of a scene that holds one; a transforms.json, a
    nerfstudio camera_path.json, a clsplat camera file (.json) or a USD stage. docs/cameras.md describes each."""
    output: Annotated[str, arg(aliases=("-o",), metavar="PATTERN")]
    """File names of the images, such as 'out/{name}.png' or 'shot/beauty.####.exr': EXR, PNG, TIFF or JPEG; or the name
    of a video of all frames, such as turn.mp4. {name} is the image's name without its extension, sub-folders included,
    or else the frame's number; ####, %04d and {frame} are the frame's number."""
    path: Annotated[Literal["turntable", "spiral", "through"] | None, arg(metavar="turntable|spiral|through")] = None
    """A path made from the cameras, in place of the cameras themselves: around what they look at, the same twice while
    rising and sinking, or through them in their order, smoothed. Its frames count from 1."""
    count: Annotated[int | None, arg(metavar="INT")] = None
    """Frames of the path; 120 if not given."""
    frames: Annotated[str | None, arg(metavar="1-100,200-300:2,...")] = None
    """Render these frames only; all if not given. Ranges may have a step. Write --frames=-5-10 if it begins with a
    negative number."""
    usd_camera: Annotated[str | None, arg(metavar="PRIM")] = None
    """Path or name of the camera, for a USD stage that has several."""
    channels: Annotated[str, arg(metavar="NAME,...")] = "rgb"
    """Channels of the files: rgb, alpha, and in EXR depth, median and first (depths), normals, position, motion, count
    and id (of Gaussians). docs/render.md has each."""
    background: Annotated[str | None, arg(metavar="black|white|R,G,B")] = None
    """Colour behind the Gaussians, the numbers from 0 to 1; black if not given."""
    alpha: Flag = False
    """Write alpha too, as --channels rgb,alpha does, and no background: premultiplied in EXR and TIFF, straight in
    PNG."""
    exr: ExrDepth = EXR_DEPTH
    """Floats of 16 or 32 bits in EXR, for colour, alpha and normals; depths, positions and motion are always of 32."""
    parts: Parts = "one"
    """one: all channels of an EXR file in one part; several: a part for colour with alpha and one for each other
    channel."""
    compression: Compression = "zip"
    """Compression of EXR files. pxr24, dwaa and dwab change the values a little; the others keep every bit."""
    bits: Literal[8, 16] = 8
    """Bits of each channel in PNG and TIFF files."""
    quality: int = 95
    """Quality of JPEG files, from 1 to 100, the best."""
    width: Annotated[int | None, arg(metavar="INT")] = None
    """Width in pixels; follows from the height, or from the camera, if not given. With a height of another shape than
    the camera's the vertical angle of view is kept."""
    height: Annotated[int | None, arg(metavar="INT")] = None
    """Height in pixels; follows from the width, or from the camera, if not given."""
    scale: float = 1.0
    """Factor on the camera's width and height, such as 0.5, where neither --width nor --height is given."""
    colour: Annotated[ColourConfig, arg(name="")] = field(default_factory=ColourConfig)
    framing: Annotated[FramingConfig, arg(name="")] = field(default_factory=FramingConfig)
    sampling: Annotated[SamplingConfig, arg(name="")] = field(default_factory=SamplingConfig)
    deep: Flag = False
    """Write deep EXR: of each pixel colour, alpha and depth in slices of the scene. docs/pictures.md has how."""
    slices: Annotated[DeepConfig, arg(name="deep")] = field(default_factory=DeepConfig)
    video: VideoConfig = field(default_factory=VideoConfig)
    preset: Annotated[Preset | None, arg(metavar="exact|default|fast")] = None
    """Bundle of rasterizer settings: exact and default approximate nothing, fast does a little. A --rasterizer flag
    overrides it. If not given: the run's own settings, else default."""
    overwrite: Flag = False
    """Replace a video that is there, and pictures that clsplat did not make. Frames of its own are replaced without it,
    but for --skip-existing."""
    skip_existing: Flag = False
    """Leave out frames whose file is there and can be read to its end, of this size, these channels, this model and,
    as far as it says so (EXR, PNG), made with these cameras and settings."""
    dry_run: Flag = False
    """Print what would be done, and do nothing: frames, sizes, channels, memory, files."""
    progress: Literal["auto", "json", "openjd", "none"] = "auto"
    """auto: a bar on a terminal, and a line for each frame written; json: an object a line for each frame, on standard
    output, or with --json on standard error; openjd: what Open Job Description shows as progress."""
    profile: Flag = False
    """Measure what part of the time the device is at work, and with --json how long on each frame."""
    device: Annotated[str | None, arg(metavar="DEVICE,...|all")] = None
    """OpenCL device: an index, cpu, gpu, or a part of a name, as `clsplat devices` lists them; several, with commas,
    share the frames. If not given: CLSPLAT_DEVICE, else the first GPU, else the first device."""
    workers: Annotated[int | None, arg(metavar="INT")] = None
    """Render in this many processes on this machine, as a Dask cluster. Needs the extra: pip install
    'clsplat[farm]'."""
    scheduler: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """Render on the Dask cluster of the scheduler at this address, such as tcp://host:8786. Its workers need the model
    and the output folder under the same paths."""
    max_device_mem: Memory = None
    """Most device memory to use, such as 256MiB or 2G. What needs more is done in pieces: slower, with the same result.
    If not given: all that the device has."""
    json: Flag = False
    """Print the frames as JSON when all are done: name, frame, path, width, height, seconds, skipped, blank (nothing of
    the model is seen). With --dry-run: the plan."""
    rasterizer: RasterizerConfig = field(default_factory=RasterizerConfig)


@dataclass(frozen=True)
class Bench:
    """Measure each stage of a frame and of a training step, and the device's own limits in the same run.

    docs/performance.md says what the figures mean.
    """

    source: Annotated[Positional[Path | None], arg(metavar="SCENE|RUN|MODEL")] = None
    """A scene as training starts it, a run, or a model file; a made-up scene if not given."""
    gaussians: int = 200_000
    """Gaussians of the made-up scene."""
    size: Annotated[str | None, arg(metavar="WIDTHxHEIGHT")] = None
    """Size of the frame in pixels. If not given: the camera's, or 1024x768 for the made-up scene."""
    repeat: int = 5
    """Measurements of each kind of frame and step; the median of their times is printed."""
    preset: Preset = "default"
    """Bundle of rasterizer settings: exact and default approximate nothing, fast does a little. A --rasterizer flag
    overrides it."""
    plot: Annotated[Path | None, arg(metavar="FILE")] = None
    """Measure every setting of the rasterizer too, and draw two plots, .svg or .png. For NAME.svg: NAME-switches.svg,
    what each exact switch is worth, and NAME-error.svg, time against error of the approximate settings."""
    overwrite: Flag = False
    """Replace plots that are there."""
    device: Device = None
    """OpenCL device: an index, cpu, gpu, or a part of a name, as `clsplat devices` lists them.
    If not given: CLSPLAT_DEVICE, else the first GPU, else the first device."""
    max_device_mem: Memory = None
    """Most device memory to use, such as 256MiB or 2G. What needs more is done in pieces: slower, with the same result.
    If not given: all that the device has."""
    json: Flag = False
    """Print the result as JSON."""
    rasterizer: BenchSwitches = field(default_factory=BenchSwitches)


@dataclass(frozen=True)
class Tune:
    """Find the quickest shape of the kernels for a device by a short trial, and keep it for later runs.

    A shape is how many pixels a kernel works on at once, and how many work-items share a tile. A run that is resumed,
    or repeated for the same bytes, wants the shape that it had. CLSPLAT_SHAPE=LANESxITEMS overrides what is kept.
    """

    device: Device = None
    """OpenCL device: an index, cpu, gpu, or a part of a name, as `clsplat devices` lists them.
    If not given: CLSPLAT_DEVICE, else the first GPU, else the first device."""
    forget: Flag = False
    """Go back to the default shape, without a trial."""
    json: Flag = False
    """Print the result as JSON."""


@dataclass(frozen=True)
class Selftest:
    """Test every device: build the kernels, run each stage on frozen scenes, compare with float64 and stored digests.

    Exit status 1 where a driver cannot be trusted. train, eval, render, view, bench, demo and, where it renders,
    convert make a short form of this test the first time they meet a device; CLSPLAT_TRUST_DRIVER=1 leaves that out. A
    shape of the kernels in which a driver failed is tried anew here.
    """

    device: Device = "all"
    """all, or one of them: an index, cpu, gpu, or a part of a name, as `clsplat devices` lists them."""
    json: Flag = False
    """Print the result as JSON."""


Verb = Devices | Demo | Sfm | Train | Eval | Render | View | Report | Compare | Convert | Info | Bench | Tune | Selftest
Commands = (
    Annotated[Devices, subcommand("devices")]
    | Annotated[Demo, subcommand("demo")]
    | Annotated[Sfm, subcommand("sfm")]
    | Annotated[Train, subcommand("train")]
    | Annotated[Eval, subcommand("eval")]
    | Annotated[Render, subcommand("render")]
    | Annotated[View, subcommand("view")]
    | Annotated[Report, subcommand("report")]
    | Annotated[Compare, subcommand("compare")]
    | Annotated[Convert, subcommand("convert")]
    | Annotated[Info, subcommand("info")]
    | Annotated[Bench, subcommand("bench")]
    | Annotated[Tune, subcommand("tune")]
    | Annotated[Selftest, subcommand("selftest")]
)
DESCRIPTION = "3D Gaussian Splatting on any OpenCL device: photos in, scene out."


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line, `sys.argv` if none is given; returns the exit status."""
    try:
        status = _run(arguments)
        sys.stdout.flush()  # here and not at the interpreter's end, where a reader that has gone would be a traceback
    except OSError as error:
        if not reader_has_gone(error):  # a file that standard output goes to cannot be written
            _tell(f"clsplat: error: standard output: {system_trouble(error)}")
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return status


def _run(arguments: Sequence[str] | None) -> int:
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        debug = switched_on("CLSPLAT_DEBUG")
    except InputError as error:
        _tell(f"clsplat: error: {error}")
        return error.exit_status
    with warnings.catch_warnings():
        warnings.showwarning = cast("Any", _show_warning)
        if not debug:
            warnings.simplefilter("ignore")
        warnings.filterwarnings("always", category=UserWarning, module=r"clsplat\b|__main__")
        try:
            if arguments == ["--version"]:
                import clsplat

                print(f"clsplat {clsplat.__version__}")
                return 0
            from clsplat.cli import verbs

            with terminable():
                return verbs.run(parse(arguments))
        except SystemExit as error:  # --help, or a wrong call that has been reported
            return error.code if isinstance(error.code, int) else 1
        except KeyboardInterrupt as error:
            if debug:
                traceback.print_exc()
            with contextlib.suppress(OSError):  # the terminal may be gone
                print("clsplat: interrupted", file=sys.stderr)
            return status_of(error)
        except (ClsplatError, OSError, MemoryError) as error:
            if isinstance(error, OSError) and reader_has_gone(error):
                raise
            if debug:
                traceback.print_exc()
            _tell(f"clsplat: error: {one_line(error)}")
            return error.exit_status if isinstance(error, ClsplatError) else 1
        except Exception as error:
            if debug or not type(error).__module__.startswith("pyopencl"):
                raise
            print(f"clsplat: error: the OpenCL driver failed: {one_line(error)}", file=sys.stderr)
            return 1


def parse(arguments: Sequence[str]) -> Verb:
    """The verb that the command line asks for. Raises SystemExit, with the trouble reported, as argparse does."""
    verb: Verb = _tyro(Commands, arguments, prog="clsplat", description=DESCRIPTION)
    if isinstance(verb, Train) and verb.resume:
        from clsplat.runs.run import Run, check_output

        for flag, value, usual in (("preset", verb.preset, "default"), ("schedule", verb.schedule, None)):
            if value != usual:
                raise InputError(f"--{flag} {value} and --resume exclude each other: the run has its settings")
        check_output(verb.output, resume=True, overwrite=verb.overwrite)
        # Once more, with the run's settings as the defaults: only flags that are given differ from them.
        earlier = Run.open(verb.output)
        default = replace(verb, config=earlier.config, **_unset(verb))
        verb = _tyro(Train, arguments[1:], prog="clsplat train", default=default)
    elif isinstance(verb, Train) and (verb.preset, verb.schedule) != ("default", None):
        # Once more, as above, with the bundles' settings as the defaults.
        config = bundled(verb.preset, verb.schedule, verb.config.iterations)
        default = replace(verb, config=config, **_unset(verb))
        verb = _tyro(Train, arguments[1:], prog="clsplat train", default=default)
    elif isinstance(verb, Bench) and verb.preset != "default":
        bench = replace(verb, rasterizer=PRESETS[verb.preset].switches(), **_unset(verb))
        verb = _tyro(Bench, arguments[1:], prog="clsplat bench", default=bench)
    elif isinstance(verb, Render) and (verb.preset is not None or verb.model.is_dir()):
        from clsplat.models.formats import model_path
        from clsplat.runs.run import Run, is_run

        bundle = RasterizerConfig()
        if verb.preset is not None:
            bundle = PRESETS[verb.preset]
        elif is_run(verb.model) or model_path(verb.model) == verb.model:  # refused, if it is neither
            bundle = Run.open(verb.model).config.rasterizer
        if bundle != RasterizerConfig():
            render = replace(verb, rasterizer=bundle, **_unset(verb))
            verb = _tyro(Render, arguments[1:], prog="clsplat render", default=render)
    return verb


def _unset(verb: Verb) -> dict[str, Any]:
    """The flags of a verb, none given: where the default is that one is, it cannot be given again."""
    return {each.name: False for each in fields(verb) if isinstance(getattr(verb, each.name), bool)}


def _tyro(kind: Any, arguments: Sequence[str], **options: Any) -> Any:
    """`tyro.cli` with our lists, and its report of a wrong call made one line."""
    report = io.StringIO()
    helping = not {"-h", "--help"}.isdisjoint(arguments)
    try:
        with _comma_separated(), contextlib.redirect_stderr(report), _columns(None if helping else 10_000):
            return tyro.cli(kind, args=list(arguments), **options)
    except SystemExit as error:
        if error.code == 2:
            _tell(f"clsplat: error: {_unboxed(report.getvalue())}")
        else:
            sys.stderr.write(report.getvalue())
        raise


def _comma_separated() -> tyro.constructors.ConstructorRegistry:
    """Lists of steps are written 500,1000,2000, tyro by itself wants spaces; a path that is empty, as a shell makes it
    of a variable that is not set, is not the folder one is in."""
    registry = tyro.constructors.ConstructorRegistry()

    @registry.primitive_rule
    def path(info: tyro.constructors.PrimitiveTypeInfo) -> tyro.constructors.PrimitiveConstructorSpec[Any] | None:
        if info.type is not Path:
            return None
        return tyro.constructors.PrimitiveConstructorSpec(
            nargs=1,
            metavar="PATH",
            instance_from_str=lambda words: _path(words[0]),
            is_instance=lambda value: isinstance(value, Path),
            str_from_instance=lambda value: [str(value)],
        )

    @registry.primitive_rule
    def steps(info: tyro.constructors.PrimitiveTypeInfo) -> tyro.constructors.PrimitiveConstructorSpec[Any] | None:
        if get_origin(info.type) is not tuple or not set(get_args(info.type)) <= {int, Ellipsis}:
            return None
        return tyro.constructors.PrimitiveConstructorSpec(
            nargs=1,
            metavar="STEP,STEP,...",
            instance_from_str=lambda words: _steps(words[0]),
            is_instance=lambda value: isinstance(value, tuple),
            str_from_instance=lambda value: [",".join(map(str, value))],
        )

    return registry


def _path(text: str) -> Path:
    if not text:
        raise ValueError("the path is empty, expected a name")
    return Path(text)


def _steps(text: str) -> tuple[int, ...]:
    try:
        steps = tuple(int(word) for word in text.split(",") if word.strip())
    except ValueError:
        raise ValueError(f"{text!r} is not a list of steps, expected such as 500,1000,2000") from None
    return steps


@contextlib.contextmanager
def _columns(count: int | None) -> Iterator[None]:
    """Make the terminal look `count` columns wide: a report to be joined to one line must not be wrapped first."""
    before = os.environ.get("COLUMNS")
    if count is not None:
        os.environ["COLUMNS"] = str(count)
    try:
        yield
    finally:
        if before is not None:
            os.environ["COLUMNS"] = before
        elif count is not None:
            del os.environ["COLUMNS"]


def _unboxed(report: str) -> str:
    """The message of one of tyro's boxes as one line: its frame and its further advice taken off."""
    words: list[str] = []
    titled = "╭" in report  # else, where standard output is not UTF-8, the first rule is below the title
    for line in report.splitlines():
        text = line.strip("│ ").strip()
        if text.startswith("╭") or not text:
            continue
        if text.startswith(("─", "╰")) or not text.strip("-"):
            if titled:
                break
            titled = True
            words.clear()
        else:
            words.append(text)
    return " ".join(" ".join(words).split()) or "the call is wrong, see clsplat --help"


def _tell(line: str) -> None:
    """Print on standard error, if that takes it: the status says the same."""
    try:
        print(line, file=sys.stderr, flush=True)
    except OSError:  # what is left of it would make the interpreter end with a status of its own
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())


def one_line(error: BaseException) -> str:
    """The error's message without line breaks."""
    if isinstance(error, OSError) and not isinstance(error, ClsplatError):
        return system_trouble(error)
    if isinstance(error, MemoryError) and not isinstance(error, ClsplatError):
        return f"there is not enough main memory: {' '.join(str(error).split()) or 'the system gave no more'}"
    return " ".join(str(error).split()) or type(error).__name__


def _show_warning(message: Warning | str, *_: Any) -> None:
    """Print a warning in one line, in place of `warnings.showwarning`, which would print the line of code as well."""
    print(f"clsplat: warning: {' '.join(str(message).split())}", file=sys.stderr)
