# SPDX-License-Identifier: Apache-2.0
"""Kernel shapes (lanes x work-items) of a device: the default, the one that `clsplat tune` saved, or CLSPLAT_SHAPE."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import pyopencl as cl

from clsplat.device.drivers import driver_records
from clsplat.device.drivers.capabilities import capabilities_of
from clsplat.device.drivers.quirks import most_lanes, subgroup_ways, title
from clsplat.device.drivers.worker_process import regardless
from clsplat.errors import DeviceError, reason_of
from clsplat.files.documents import parse_json
from clsplat.files.user_cache import cache_folder

VECTOR_LANES = (1, 4, 8, 16)
"""Allowed numbers of pixels per vector."""
BY_GAUSSIAN_SHAPES = ((1, 32), (1, 64))
"""Lanes and items of the shapes that may have the suffix `g` (`Shape.by_gaussian`)."""
SUBGROUP_SHAPES = (*BY_GAUSSIAN_SHAPES, (1, 128), (1, 256))
"""Lanes and items of the shapes that may have the suffix `s` (`Shape.subgroups`)."""
_SHAPES_BY_SUFFIX = {"g": BY_GAUSSIAN_SHAPES, "s": SUBGROUP_SHAPES}


@dataclass(frozen=True)
class Shape:
    """The shape of the kernels for a device.

    lanes: pixels per vector in the blend kernels (1 on GPUs).
    items: work-items per work-group in kernels whose items co-operate (1 on CPUs, which run a group as a sequential
    loop).
    chunks: number of chunks in a scan or sort if `items` is 1.
    by_gaussian: in the gradient of blending, a work-item has a Gaussian and loops over pixels; if False, it has pixels
    and loops over Gaussians (docs/decisions/0023-a-group-shares-a-tile.md). True only in BY_GAUSSIAN_SHAPES.
    subgroups: in the gradient of blending, the work-items of a sub-group sum by exchanging values. The sums have the
    same bits as without sub-groups. True only in SUBGROUP_SHAPES.
    """

    lanes: int
    items: int
    chunks: int
    by_gaussian: bool = False
    subgroups: bool = False

    @property
    def label(self) -> str:
        """The value of CLSPLAT_SHAPE for this shape: LANESxITEMS, then `g` if `by_gaussian`, or `s` if `subgroups`."""
        return f"{self.lanes}x{self.items}{'g' if self.by_gaussian else 's' if self.subgroups else ''}"

    @property
    def words(self) -> str:
        """The shape in words, such as "8 lanes x 1 items"."""
        form = ", by Gaussian" if self.by_gaussian else ", with sub-groups" if self.subgroups else ""
        return f"{self.lanes} lanes x {self.items} items{form}"

    def relabelled(self, label: str) -> Shape:
        """A copy of this shape that has the lanes, items and suffix of `label`. Raises ValueError if it is invalid."""
        match = re.fullmatch(r"(\d+)x(\d+)([gs]?)", label.strip())
        lanes, items, form = (int(match[1]), int(match[2]), match[3]) if match else (0, 0, "")
        if (
            lanes not in VECTOR_LANES
            or items < 1
            or items & (items - 1)
            or (form and (lanes, items) not in _SHAPES_BY_SUFFIX[form])
        ):
            raise ValueError(f"{label} is not a kernel shape, expected LANESxITEMS, such as 8x1")
        return replace(self, lanes=lanes, items=items, by_gaussian=form == "g", subgroups=form == "s")

    @property
    def digit_bits(self) -> int:
        """Bits per digit in the radix sort. Local memory has room for a counter for each value of a digit."""
        return 11 if self.items == 1 else 8

    @property
    def sort_items(self) -> int:
        """Work-items in a group of the radix sort: at most 256, so that its local memory fits in 32 KiB."""
        return min(self.items, 256)

    @property
    def local_bytes(self) -> int:
        """Bytes of local memory that a group needs in the radix sort, which needs the most of all kernels.

        With one item, the sort holds the counters of wide digits. Otherwise it holds 16 keys per item, 16 counters of
        16 bits per item, a sum per item, padding, and a counter per digit.
        """
        if self.items == 1:
            return 32 << 10
        words = 24 * self.sort_items
        return 4 * (words + words // 32 + self.sort_items + (1 << self.digit_bits))


def default_shape(device: cl.Device) -> Shape:
    """The shape (pixels per vector, work-group size) for the device's type and vector width
    (docs/decisions/0003-one-source-many-shapes.md)."""
    if capabilities_of(device).kind != "cpu":
        items = next((n for n in (64, 32, 16) if n <= most_items(device)), 1)
        return Shape(lanes=1, items=items, chunks=4 * device.max_compute_units)
    lanes = min(16 if device.native_vector_width_float >= 16 else 8, most_lanes(device))
    return Shape(lanes=lanes, items=1 if lanes > 1 else 64, chunks=4 * device.max_compute_units)


def most_items(device: cl.Device) -> int:
    """Maximum work-items in a group of clsplat's kernels, by the device's group limit and its local memory."""
    capabilities = capabilities_of(device)
    most = capabilities.group
    while most > 1 and Shape(1, most, 1).local_bytes > capabilities.local_memory:
        most //= 2
    return most


def candidates(device: cl.Device) -> list[Shape]:
    """The shapes that `clsplat tune` measures, the default first."""
    default = default_shape(device)
    if capabilities_of(device).kind == "cpu":
        others = [replace(default, lanes=lanes) for lanes in (16, 8)]
    else:
        others = [replace(default, items=items) for items in (32, 128, 256) if items <= most_items(device)]
        forms = "gs" if subgroup_ways(device) else "g"
        others += [
            default.relabelled(f"{n}x{k}{form}")
            for form in forms
            for n, k in BY_GAUSSIAN_SHAPES
            if k <= most_items(device)
        ]
    return [default, *(shape for shape in others if shape != default)]


def asked_shape() -> str:
    """Return the value of CLSPLAT_SHAPE, or "" if it is not set. Raises DeviceError if it is not a shape label."""
    text = os.environ.get("CLSPLAT_SHAPE", "")
    if text and _parsed(text, Shape(1, 1, 1)) is None:
        raise DeviceError(
            f"CLSPLAT_SHAPE={text}: expected LANESxITEMS, such as 8x1 or 1x256; with 1, 4, 8 or 16 lanes; "
            f"{' or '.join(f'{lanes}x{items}' for lanes, items in BY_GAUSSIAN_SHAPES)} may end in g (in the gradient, "
            "a work-item has a Gaussian), and "
            f"{', '.join(f'{lanes}x{items}' for lanes, items in SUBGROUP_SHAPES)} in s (with sub-groups)"
        )
    return text


def wanted_shape(device: cl.Device) -> Shape:
    """The shape that CLSPLAT_SHAPE requests, else the one that `clsplat tune` saved, else the default.

    Raises DeviceError if CLSPLAT_SHAPE is invalid, or the device cannot run it.
    """
    default, text = default_shape(device), asked_shape()
    shape = _parsed(text or saved_shapes().get(driver_records.device_key(device), ""), default)
    lacking = shape is not None and shape.subgroups and not subgroup_ways(device)
    if shape is None or (not text and (lacking or shape.items > most_items(device))):
        return default
    name, capabilities = device.name.strip(), capabilities_of(device)
    if lacking:
        raise DeviceError(
            f"CLSPLAT_SHAPE={text}: {name} has no sub-groups whose items exchange values; expected a shape without the "
            f"s, such as {text.strip()[:-1]}"
        )
    if shape.items > capabilities.group:
        raise DeviceError(f"CLSPLAT_SHAPE={text}: {name} has at most {capabilities.group} items in a work-group")
    if shape.items > most_items(device):
        raise DeviceError(
            f"CLSPLAT_SHAPE={text}: {name} has {capabilities.local_memory >> 10} KiB of local memory, and a group of "
            f"{shape.items} items needs {shape.local_bytes >> 10} KiB; expected at most {most_items(device)} items"
        )
    return shape


def failures(device: cl.Device) -> dict[str, str]:
    """Return descriptions of the driver's recorded failures, by shape label; empty with CLSPLAT_TRUST_DRIVER=1."""
    if regardless():
        return {}
    return {label: entry.failed for label, entry in driver_records.entries(device).items() if entry.failed}


def shape_of(device: cl.Device) -> tuple[Shape, str]:
    """Return the shape for a device that is opened without an explicit shape, and a warning or an empty string.

    The shape is `wanted_shape`. If the driver has a recorded failure in it, the next shape without a failure is
    returned instead, and the warning says so. Raises DeviceError like `wanted_shape`.
    """
    wanted, failed = wanted_shape(device), failures(device)
    shape = shapes_to_try(device, wanted, failed)[0]
    return shape, "" if shape == wanted else instead(device, wanted, shape, failed[wanted.label])


def shape_text(device: cl.Device) -> str:
    """Return the shape in words for the list of devices, or a note that the device cannot run CLSPLAT_SHAPE."""
    try:
        shape, _ = shape_of(device)
    except DeviceError:
        return f"cannot take CLSPLAT_SHAPE={asked_shape()}"
    return shape.words


def shapes_in_turn(device: cl.Device) -> list[Shape]:
    """Return all shapes for a device in the order to try them: the default, the others that `clsplat tune` measures,
    then shapes with fewer lanes or items, which demand less of a compiler."""
    first = candidates(device)
    default = first[0]
    smaller = [replace(default, lanes=lanes, items=1) for lanes in (4, 1)] if default.items == 1 else []
    smaller += [replace(default, items=items) for items in (128, 64, 32) if items < default.items]
    return [*first, *(shape for shape in smaller if shape not in first)]


def shapes_to_try(device: cl.Device, first: Shape, failed: Mapping[str, str]) -> list[Shape]:
    """Return the shape `first`, then the results of `shapes_in_turn`, but no shape in `failed`.

    failed: the driver's recorded failures by shape label.
    If the driver has failed in every shape, `first` is tried again, because the cause may be gone.
    """
    shapes = dict.fromkeys((first, *shapes_in_turn(device)))
    return [shape for shape in shapes if shape.label not in failed] or [first]


def instead(device: cl.Device, wanted: Shape, other: Shape, failure: str) -> str:
    """Return the warning that the shape `other` is used because kernels failed in the shape `wanted`.

    failure: description of the recorded failure.
    """
    return (
        f"{title(device)}: kernels in the shape {wanted.label} failed: {failure}; {other.label} is "
        f"used instead (clsplat selftest tries {wanted.label} again)"
    )


def _parsed(text: str, default: Shape) -> Shape | None:
    try:
        return default.relabelled(text)
    except ValueError:
        return None


def saved_path() -> Path:
    """The file in which `clsplat tune` saves its results."""
    return cache_folder() / "shapes.json"


def saved_shapes() -> dict[str, str]:
    """The shape labels that `clsplat tune` saved, by `device_key`. An invalid file is ignored with a warning."""
    path = saved_path()
    try:
        saved = parse_json(path.read_bytes())
    except (FileNotFoundError, NotADirectoryError):  # the home folder may be missing, or be a file
        return {}
    except OSError as error:
        warnings.warn(f"{path}: cannot be read ({reason_of(error)}), so no tuned shape is used", stacklevel=2)
        return {}
    except ValueError:
        saved = None
    if not isinstance(saved, dict) or not all(isinstance(value, str) for value in saved.values()):
        warnings.warn(
            f"{path}: the file is damaged, so no tuned shape is used; clsplat tune writes it again", stacklevel=2
        )
        return {}
    return saved


def save_shape(device: cl.Device, shape: Shape | None) -> None:
    """Save a shape for the device with its current driver. None removes the saved shape. Raises OSError."""

    def changed() -> dict[str, str]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            saved = saved_shapes()
        saved.pop(driver_records.device_key(device), None)
        return saved if shape is None else {**saved, driver_records.device_key(device): shape.label}

    driver_records.rewrite(saved_path(), changed)
