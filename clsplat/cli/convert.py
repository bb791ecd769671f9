# SPDX-License-Identifier: Apache-2.0
"""`clsplat convert`: conversion of a model file to another format, with optional edits."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from math import inf, isclose, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from typing_extensions import NotRequired, TypedDict
from tyro.conf import Positional, arg

from clsplat.cli.options import DeviceOptions, Flag, RunOrModel, ScenePath, Verb
from clsplat.cli.session import Services, load_scene
from clsplat.config.checks import Rule, check_rules
from clsplat.config.cli_defaults import TEST_EVERY
from clsplat.config.masks import NO_MASKS
from clsplat.config.orientation import AS_IN_FILES
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError, warn
from clsplat.files.atomic import atomic_write, check_new, remove
from clsplat.files.documents import is_file, read_document
from clsplat.progress import StageProgress
from clsplat.selftest.result import FORWARD_STAGES

if TYPE_CHECKING:
    from clsplat.arrays import Float32, Float64
    from clsplat.camera import Camera
    from clsplat.gaussians import Gaussians
    from clsplat.models.formats import Format
    from clsplat.scenes.geography.georeference import Georeference

    NamedModel = tuple[Path, Gaussians]

SILENT_WRITE_SECONDS = 2.0
"""Seconds that writing a file may take before progress is shown."""
NEAR_PLANE_RELATIVE_TOLERANCE = 0.05
"""Largest relative change of the near plane without a warning. Readers of a format that does not store the near plane
derive it from positions, which the format may round."""
MAX_MATRIX_FILE_BYTES = 1 << 16
"""Maximum size in bytes of a file for --transform."""


class ModelFile(TypedDict):
    """Description of a model file in the report of --json, with its size in bytes."""

    path: str
    format: str
    bytes: int
    gaussians: int
    sh_degree: int


class ViewComparison(TypedDict):
    """PSNR in dB of a view's renders before and after conversion, and between the two renders."""

    name: str
    before: float
    after: float
    between: float


class SceneComparison(TypedDict):
    """Mean PSNR in dB over the views of --scene, and the lowest PSNR between the two renders of a view."""

    before: float
    after: float
    between: float
    least_between: float
    views: list[ViewComparison]


class ConversionReport(TypedDict):
    """The report that `clsplat convert --json` prints.

    errors: largest and mean error of each attribute (`difference.errors`).
    scene: comparison on the scene, if --scene is specified.
    """

    source: ModelFile
    target: ModelFile
    errors: dict[str, dict[str, float]]
    scene: NotRequired[SceneComparison]


@dataclass(frozen=True)
class ConvertVerb(Verb):
    """Convert a model to the format of the output file's ending, with optional edits, and report rounding errors.

    Edits are made in this order: merge, crop, prune, frame, transform, rotate, scale, translate, drop-sh. Only --scene
    and --prune-contribution need a device. docs/formats.md describes the formats.
    """

    source: RunOrModel
    """A run's folder or a model file."""
    target: Annotated[Positional[Path], arg(metavar="OUTPUT")]
    """The file to write."""
    overwrite: Flag = False
    """Replace an existing file, even the source."""
    activated: Annotated[Literal["opacities", "scales", "both"] | None, arg(metavar="opacities|scales|both")] = None
    """Read the source's opacities (0 to 1, 0 to 100 or 0 to 255), its scales, or both as plain values. Use this for a
    file that stores plain values instead of the usual logits and logarithms. Files that seem to do so cause a warning.
    """
    merge: Annotated[tuple[Path, ...], arg(metavar="FILE...")] = ()
    """Add the Gaussians of these model files."""
    crop: Annotated[str | None, arg(metavar="X0,Y0,Z0,X1,Y1,Z1")] = None
    """Keep the Gaussians whose mean lies in this box. Write --crop=-1,... if the first number is negative."""
    crop_sphere: Annotated[str | None, arg(metavar="X,Y,Z,R")] = None
    """Keep the Gaussians whose mean lies in this sphere."""
    prune_opacity: Annotated[float | None, arg(metavar="FLOAT")] = None
    """Leave out Gaussians with an opacity below this value, from 0 to 1."""
    prune_contribution: Annotated[float | None, arg(metavar="PIXELS")] = None
    """Leave out Gaussians that contribute less than this number of pixels to every picture of --cameras. A
    contribution is alpha times transmittance, summed over the picture, like --density.min-contribution in training."""
    cameras: Annotated[Path | None, arg(metavar="PATH")] = None
    """Cameras for --prune-contribution, in any format that `clsplat render` reads."""
    frame: Annotated[Literal["source"] | None, arg(metavar="source")] = None
    """source: bring the model of a run back to the frame that the scene's cameras had before --orient and --scale of
    clsplat sfm and train, such as COLMAP's own."""
    transform: Annotated[str | None, arg(metavar="FILE|M00,M01,...")] = None
    """Transform the model by a 4 x 4 matrix: rotation, uniform scale, translation, and a mirror if wanted. Give 16
    numbers row by row, separated by commas, or a text file with them. Spherical harmonics are rotated too."""
    rotate: Annotated[str | None, arg(metavar="X,Y,Z")] = None
    """Rotate the model by these angles in degrees about the world's x axis, then y, then z, by the right-hand rule.
    Spherical harmonics are rotated too. Write --rotate=-90,0,0 if the first number is negative."""
    scale: Annotated[float | None, arg(metavar="FLOAT")] = None
    """Multiply positions and sizes by this factor, about the world's origin."""
    translate: Annotated[str | None, arg(metavar="X,Y,Z")] = None
    """Translate the model. Write --translate=-1,0,0 if the first number is negative."""
    drop_sh: Annotated[int | None, arg(metavar="DEGREE")] = None
    """Leave out spherical harmonics (view-dependent colour) above this degree, 0 to 3."""
    up: Annotated[Literal["y", "z"] | None, arg(metavar="y|z")] = None
    """Up axis to declare in a USD stage; y if not given. The model is not rotated: use --rotate for that."""
    spz_version: Annotated[Literal[2, 3, 4] | None, arg(metavar="2|3|4")] = None
    """Version of an SPZ file; 3 if not given. Version 4 is up to a tenth smaller, and the only one that PlayCanvas's
    engine reads. Spark, Babylon.js and older three.js refuse it. docs/formats.md lists the readers of each version."""
    sh_bits: Annotated[str | None, arg(metavar="BITS|BITS,BITS")] = None
    """Bits of an SPZ file's spherical harmonics, 1 to 8, for band 1 and for the bands above. Fewer bits make a smaller
    file with less accurate reflections. 6,6 if not given; SPZ's own library uses 5,4."""
    scene: ScenePath = None
    """Measure PSNR on this scene's held-out views before and after conversion, and between the two renders. If the
    source is a run that was trained on this scene, pixels that the scene's masks exclude are not measured."""
    test_every: int = TEST_EVERY
    """Every n-th view of --scene in name order is held out. 0: all views are measured."""
    resolution: int = 0
    """Longest image side in pixels, for --scene. 0: the images' size up to 1600."""
    background: Literal["black", "white"] = "black"
    """Background behind the Gaussians and behind images with alpha, for --scene."""
    device: Annotated[DeviceOptions, arg(name="")] = field(default_factory=DeviceOptions)
    json: Flag = False
    """Print the result as JSON."""


def run(verb: ConvertVerb, services: Services) -> int:
    """Convert the model and print how far values were rounded. Checks the command line before it writes anything."""
    from clsplat.images import colour
    from clsplat.models import difference, edit
    from clsplat.models.formats import colour_space, format_of, format_of_name, load, save
    from clsplat.runs.run import model_file

    source, merged = model_file(verb.source), [model_file(path) for path in verb.merge]
    _check(verb)
    matrix = _similarity(verb)
    target_format = format_of_name(verb.target, writable=True)
    check_new(verb.target, overwrite=verb.overwrite, sources=[source, *merged])
    for companion in target_format.side_files(verb.target):
        check_new(companion, overwrite=verb.overwrite)
    options = _of_format(verb, target_format)
    place = _place_of(verb, source, matrix)
    original, space = load(source, activated=verb.activated), colour_space(source)
    edited = _edited(verb, services, (source, original), [(path, load(path)) for path in merged], matrix)
    if not target_format.floats:
        edited = edit.without_empty_bands(edited)
    comments = () if space == colour.SRGB else (colour.comment(space),)
    save(verb.target, edited, comments=comments, progress=StageProgress(after=SILENT_WRITE_SECONDS), **options)
    _keep_place(verb, place, matrix)
    if space != colour_space(verb.target):
        warn(f"{verb.target}: {target_format.name} cannot store the colour space, {space}; readers will assume sRGB")
    read = load(verb.target, check_encoding=False)  # reading the source has already warned of odd encodings
    kind = target_format.name
    if not isclose(read.near, edited.near, rel_tol=NEAR_PLANE_RELATIVE_TOLERANCE):
        warn(f"{verb.target}: {kind} cannot store the near plane {edited.near:.4g}; readers will use {read.near:.4g}")
    if read.antialiased != edited.antialiased:
        warn(f"{verb.target}: {kind} cannot store antialiasing; readers will draw small or distant Gaussians too thick")
    if read.by_rays != edited.by_rays:
        warn(
            f"{verb.target}: {kind} cannot store projection along rays; readers will project Gaussians onto the image "
            "plane, and show large ones outside the picture as a haze"
        )
    written = edit.take(edited, target_format.order(edited)) if target_format.order else edited
    result: ConversionReport = {
        "source": _described(source, format_of(source), original),
        "target": _described(verb.target, target_format, read),
        "errors": difference.errors(written, read),
    }
    if verb.scene is not None:
        result["scene"] = _measured(verb, services, original, read, matrix)
    if verb.json:
        print(json.dumps(result, indent=2))
        return 0
    for model in (result["source"], result["target"]):
        gaussians = f"{model['gaussians']:,} Gaussians of SH degree {model['sh_degree']}"
        print(f"{model['path']}: {model['format']}, {gaussians}, {model['bytes']:,} bytes")
    print(difference.table(result["errors"]))
    if verb.scene is not None:
        scene = result["scene"]
        count, before, after = len(scene["views"]), scene["before"], scene["after"]
        print(f"PSNR of {count} views against photographs: {before:.2f} dB before conversion, {after:.2f} dB after it")
        mean, least = scene["between"], scene["least_between"]
        print(f"PSNR between the two renders of a view: {mean:.2f} dB on average, {least:.2f} dB at the lowest")
    return 0


def _place_of(verb: ConvertVerb, source: Path, matrix: Float64 | None) -> Georeference | None:
    """Return the place on the earth of the model file `source`; None if it is unknown.

    matrix: as for `_keep_place`. A mirrored model gets no place, with a warning, as records have rotations alone.
    Raises InputError if the target's record of its place may not be written.
    """
    import numpy as np

    from clsplat.scenes.geography.georeference import beside_model, read_of_model

    place = read_of_model(source)
    if place is None:
        return None
    if matrix is not None and np.linalg.det(matrix[:3, :3]) < 0:
        name = beside_model(verb.target).name
        warn(f"{verb.target}: gets no {name}, as the model is mirrored; convert it without the mirror")
        return None
    check_new(beside_model(verb.target), overwrite=verb.overwrite)
    return place


def _keep_place(verb: ConvertVerb, place: Georeference | None, matrix: Float64 | None) -> None:
    """Write the target's place on the earth. Without a place, remove the record of a model that was replaced.

    place: the source's place. matrix: (4, 4), the transform of the edits; None if they do not transform the model.
    """
    from clsplat.scenes.geography.georeference import beside_model

    if place is not None:
        atomic_write(beside_model(verb.target), (place if matrix is None else place.moved(matrix)).content())
    elif verb.overwrite:
        remove(beside_model(verb.target))


def _check(verb: ConvertVerb) -> None:
    """Raise InputError for a number out of range, or for a flag without another flag that it needs."""
    from clsplat.gaussians import MAX_SH_DEGREE

    rules: tuple[Rule, ...] = (
        (("scale",), lambda value: value is None or 0 < value < inf, "a number over 0"),
        (("prune_opacity",), lambda value: value is None or 0 <= value <= 1, "0 to 1"),
        (("prune_contribution",), lambda value: value is None or 0 < value < inf, "pixels, a number over 0"),
        (("drop_sh",), lambda value: value is None or 0 <= value <= MAX_SH_DEGREE, f"0 to {MAX_SH_DEGREE}"),
        (("test_every", "resolution"), lambda value: value >= 0, "at least 0"),
    )
    check_rules(verb, "--", rules)
    if (verb.prune_contribution is None) != (verb.cameras is None):
        raise InputError("--prune-contribution and --cameras need each other: the cameras define the pictures")
    defaults = {field.name: field.default for field in fields(verb)}
    names = [name for name in ("test_every", "resolution", "background") if getattr(verb, name) != defaults[name]]
    if verb.scene is None and names:
        flags = ", ".join(f"--{name.replace('_', '-')}" for name in names)
        raise InputError(f"{flags}: has an effect only with --scene, expected --scene too")


def _described(path: Path, form: Format, gaussians: Gaussians) -> ModelFile:
    from clsplat.models.info import size

    return {
        "path": str(path),
        "format": form.name,
        "bytes": size(path, form),
        "gaussians": len(gaussians),
        "sh_degree": gaussians.sh_degree,
    }


def _edited(
    verb: ConvertVerb, services: Services, source: NamedModel, others: Sequence[NamedModel], matrix: Float64 | None
) -> Gaussians:
    """Return the source model after all edits, in the order listed by --help.

    source: path and model of the source. others: paths and models of the files of --merge.
    matrix: (4, 4), the transform of the edits; None if they do not transform the model.
    Raises InputError if no Gaussian remains.
    """
    from clsplat.models import edit

    gaussians = source[1]
    if others:
        for other in others:
            _warn_of_mismatch(other, source)
        gaussians = edit.merge([gaussians, *(other for _, other in others)])
    gaussians = _thinned(verb, services, gaussians)
    if matrix is not None:
        gaussians = edit.transform(gaussians, matrix)
    return gaussians if verb.drop_sh is None else edit.drop_sh(gaussians, verb.drop_sh)


def _of_format(verb: ConvertVerb, target: Format) -> dict[str, Any]:
    """Return the format's flags, such as --spz-version, as keyword arguments of `save`.

    Raises InputError for a flag of another format.
    """
    flags = (
        ("up", verb.up and verb.up.upper(), "up_axis", "OpenUSD"),
        ("spz-version", verb.spz_version, "version", "SPZ"),
        ("sh-bits", _sh_bits(verb.sh_bits), "sh_bits", "SPZ"),
    )
    given = [row for row in flags if row[1] is not None]
    for flag, _, _, format_name in given:
        if target.name != format_name:
            raise InputError(f"--{flag}: is for {format_name} files, but {verb.target} is {target.name}")
    return {name: value for _, value, name, _ in given}


def _sh_bits(text: str | None) -> tuple[int, int] | None:
    """Parse "6" or "5,4" to the bits of band 1 and of the higher bands. None stays None. Raises InputError."""
    if text is None:
        return None
    words = [word.strip() for word in text.split(",")]
    if not 1 <= len(words) <= 2 or not all(word.isdecimal() and 1 <= int(word) <= 8 for word in words):
        raise InputError(f"--sh-bits {text[:80]}: expected bits from 1 to 8, such as 6, or 5,4 for band 1 and the rest")
    return int(words[0]), int(words[-1])


def _warn_of_mismatch(merged: NamedModel, source: NamedModel) -> None:
    """Warn if a merged model has another colour space than the source, or is far away from the source."""
    import numpy as np

    from clsplat.models import edit
    from clsplat.models.formats import colour_space

    (path, other), (first_path, first) = merged, source
    space, expected = colour_space(path), colour_space(first_path)
    if space != expected:
        warn(f"--merge {path}: its colours are {space}, but are read as {expected}, the colour space of {first_path}")
    distance = float(np.linalg.norm(other.origin - first.origin))
    if len(other) and distance > edit.MAX_WORLD_OFFSET_SIZES * float(other.means.std(axis=0).max()):
        step = float(np.spacing(np.float32(distance)))
        warn(
            f"--merge {path}: its origin is {distance:.6g} world units from the origin of {first_path}, so that its "
            f"positions are rounded to {step:.2g} world units. Is only one of the two models georeferenced?"
        )


def _to_source_frame(source: Path) -> Float64:
    """Return the similarity (4, 4) from the frame of a run's model to the one that its cameras had first."""
    import numpy as np

    from clsplat.runs.run import run_of

    run = run_of(source)
    if run is None:
        raise InputError(
            f"--frame source: {source} is not in a run, which has the transform in frame.json; expected a run"
        )
    frame = run.frame
    return np.eye(4) if frame is None else np.asarray(np.linalg.inv(frame.world_from_source), np.float64)


def _similarity(verb: ConvertVerb) -> Float64 | None:
    """Return the matrix (4, 4) of --transform, --rotate, --scale and --translate, in this order; None without them.

    Raises InputError.
    """
    import numpy as np

    from clsplat.models import edit

    steps: list[Float64] = []
    if verb.frame is not None:
        steps.append(_to_source_frame(verb.source))
    if (text := verb.transform) is not None:
        words = read_document(Path(text), "a text file of 16 numbers", MAX_MATRIX_FILE_BYTES) if is_file(text) else text
        steps.append(np.array(_numbers("transform", words, 16)).reshape(4, 4))
        try:
            edit.decompose(steps[0])
        except InputError as error:
            raise InputError(f"--transform {text}: {error}") from None
    if verb.rotate is not None:
        steps.append(edit.turning(_numbers("rotate", verb.rotate, 3)))
    if verb.scale is not None:
        steps.append(edit.scaling(verb.scale))
    if verb.translate is not None:
        steps.append(edit.shifting(_numbers("translate", verb.translate, 3)))
    if not steps:
        return None
    matrix: Float64 = np.eye(4)
    for step in steps:
        matrix = step @ matrix
    return matrix


def _numbers(flag: str, text: str, count: int) -> list[float]:
    """Parse `count` finite numbers, separated by commas or spaces; brackets are ignored. Raises InputError.

    flag: name of the flag whose value is `text`, for the message.
    """
    words = text.translate(str.maketrans("[],;", "    ")).split()
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count or not all(map(isfinite, values)):
        raise InputError(f"--{flag} {text[:80]}: expected {count} numbers separated by commas")
    return values


def _thinned(verb: ConvertVerb, services: Services, gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians that the --crop and --prune flags keep. Raises InputError if no Gaussian remains."""
    from clsplat.models import edit
    from clsplat.rendering.contributions import largest_contributions
    from clsplat.shots import choose_shot

    def keep(flag: str, rows: Any) -> None:
        nonlocal gaussians
        if not rows.any():
            raise InputError(f"--{flag}: removes all {len(gaussians):,} Gaussians, expected some to remain")
        gaussians = gaussians if rows.all() else edit.take(gaussians, rows)

    if verb.crop is not None:
        corners = _numbers("crop", verb.crop, 6)
        if any(low > high for low, high in zip(corners[:3], corners[3:], strict=True)):
            raise InputError(f"--crop {verb.crop}: expected X0 <= X1, Y0 <= Y1 and Z0 <= Z1")
        keep("crop", edit.in_box(gaussians, corners[:3], corners[3:]))
    if verb.crop_sphere is not None:
        *centre, radius = _numbers("crop-sphere", verb.crop_sphere, 4)
        keep("crop-sphere", edit.in_sphere(gaussians, centre, radius))
    if verb.prune_opacity is not None:
        keep("prune-opacity", edit.opaque(gaussians, verb.prune_opacity))
    if verb.prune_contribution is not None and verb.cameras is not None:
        shot = choose_shot(verb.cameras)
        for text in shot.told(verb.cameras):
            warn(text)
        contributions = largest_contributions(gaussians, shot.cameras, verb.device.trusted(services))
        keep("prune-contribution", contributions >= verb.prune_contribution)
    return gaussians


def _measured(
    verb: ConvertVerb, services: Services, original: Gaussians, read: Gaussians, matrix: Float64 | None
) -> SceneComparison:
    """Measure PSNR in dB of each view's renders before and after conversion.

    Each render is compared with the photograph, and the two renders are compared with each other.
    original: the source model.
    read: the converted model, read from the target file. It is rendered from cameras transformed by `matrix`.
    matrix: (4, 4), the transform of the edits; None if they do not transform the model.
    """
    import numpy as np

    from clsplat.evaluation.held_out import photograph_of
    from clsplat.evaluation.metrics import psnr
    from clsplat.images.alpha import background_colour, composite
    from clsplat.models import edit
    from clsplat.runs.run import run_of

    device = verb.device.open(services)
    assert verb.scene is not None
    run = run_of(verb.source)
    own = run is not None and run.scene is not None and run.scene.resolve() == verb.scene.resolve()
    masks = run.config.mask_use if run is not None and own else NO_MASKS
    config = TrainConfig(resolution=verb.resolution, test_every=verb.test_every, missing="skip")
    frame = AS_IN_FILES if run is None else run.frame_for(verb.scene)
    scene = load_scene(services, verb.scene, config, masks=masks, frame=frame)
    renderer = services.renderer(services.require(device, FORWARD_STAGES))
    background = background_colour(verb.background)

    def images(gaussians: Gaussians, cameras: Sequence[Camera]) -> list[Float32]:
        return [renderer.render(gaussians, camera, background).image for camera in cameras]

    views = scene.test_views or scene.views
    cameras = [view.camera for view in views]
    moved = cameras if matrix is None else [edit.transform_camera(camera, matrix) for camera in cameras]
    records: list[ViewComparison] = []
    for view, before, after in zip(views, images(original, cameras), images(read, moved), strict=True):
        pixels, counts = photograph_of(view)
        truth = composite(pixels, background)
        records.append(
            {
                "name": view.name,
                "before": psnr(before, truth, counts),
                "after": psnr(after, truth, counts),
                "between": psnr(before, after, counts),
            }
        )
    return {
        "before": float(np.mean([record["before"] for record in records])),
        "after": float(np.mean([record["after"] for record in records])),
        "between": float(np.mean([record["between"] for record in records])),
        "least_between": min(record["between"] for record in records),
        "views": records,
    }
