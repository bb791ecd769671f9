# SPDX-License-Identifier: Apache-2.0
"""Model files: a module for each format, chosen by the file's ending, or by its first bytes where these say otherwise.

A format is a module of this package that has

- `NAME`, what it is called, and `SUFFIXES`, the endings of its files in lower case, such as .compressed.ply,
  the longest first; one without a dot is a whole name;
- `read(path) -> Gaussians`, which raises InputError, one line with the path, for a file that is not as it should be;
- `write(path, gaussians)`, atomic, with further settings as keyword arguments; absent where it is only read;
- `recognises(head) -> bool`, whether these first bytes (`HEAD_BYTES` at most) are of the format; may be absent;
- `describe(path) -> dict`, what `clsplat info` says beside what every model has; may be absent;
- `order(gaussians) -> (n,)`, which Gaussian each row of a written file is, where that is not their own order;
- `LOSES`, in a few words what the format does not keep, "nothing" for floats; and `FLOAT`, whether it keeps floats.

Its docstring cites the specification and says what the format has in place of our conventions (docs/conventions.md).
Modules load what they need of other packages when it is needed: all of them are imported to look for an ending.
"""

from __future__ import annotations

import functools
import inspect
import os
import pkgutil
import warnings
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from clsplat.camera import NEAR, NEARS
from clsplat.errors import InputError, plain
from clsplat.files import is_file, open_input
from clsplat.gaussians import Gaussians

HEAD_BYTES = 1 << 16
SAMPLED = 10_000
"""Means that tell how large a model is."""
SMALL = 10.0
"""Near planes in the size of a model that the usual one does not suit."""


@functools.cache
def formats() -> dict[str, ModuleType]:
    """Every format's module by its NAME."""
    found = (import_module(f"{__name__}.{entry.name}") for entry in pkgutil.iter_modules(__path__))
    modules = [module for module in found if hasattr(module, "SUFFIXES")]
    return {module.NAME: module for module in modules}


def suffixes(*, writable: bool = False) -> list[str]:
    """The endings that are known, or those of formats that can be written."""
    modules = [module for module in formats().values() if hasattr(module, "write") or not writable]
    return sorted(suffix for module in modules for suffix in module.SUFFIXES)


def format_of_name(path: str | os.PathLike[str], *, writable: bool = False) -> ModuleType:
    """The format of the longest ending that fits. Raises InputError for one that is not known, or not written if it
    should be."""
    name = Path(path).name.lower()
    fits = [(len(suffix), module) for module in formats().values() for suffix in module.SUFFIXES if _has(name, suffix)]
    if not fits:
        known = " ".join(suffixes(writable=writable))
        raise InputError(f"{path}: the ending is none of a model file, expected one of {known}")
    module = max(fits, key=lambda fit: fit[0])[1]
    if writable and not hasattr(module, "write"):
        known = " ".join(suffixes(writable=True))
        raise InputError(f"{path}: {module.NAME} is read only, expected one of {known}")
    return module


def _has(name: str, suffix: str) -> bool:
    return name.endswith(suffix) if suffix.startswith(".") else name == suffix


def format_of(path: Path) -> ModuleType:
    """The format by the name, unless the first bytes are another format's. Raises InputError, also where there is no
    such file."""
    named = _named(path)
    if named is not None and path.is_dir():  # the reader knows whether it may be one
        return named
    with open_input(path, f"a model file, its ending one of {' '.join(suffixes())}") as file:
        head = file.read(HEAD_BYTES)
    # of a format without a beginning of its own another's counts, but for JSON's, which says too little
    nameless = named is not None and not hasattr(named, "recognises") and head.lstrip()[:1] != b"{"
    if named is None or nameless or not _recognised(named, head):
        for module in formats().values():
            if hasattr(module, "recognises") and module.recognises(head):
                return module
    return named or format_of_name(path)


def tell_kind(path: Path, module: ModuleType) -> None:
    """Warn where the file's name says that it is of another format than it is."""
    endings = {Path(f"x{suffix}").suffix for suffix in module.SUFFIXES}
    if path.suffix.lower() not in endings:
        warnings.warn(plain(f"{path}: is {module.NAME} by its content, whatever its name says"), stacklevel=3)


def is_model_name(path: Path) -> bool:
    """True if the ending is one of a model file."""
    return _named(path) is not None


def _named(path: Path) -> ModuleType | None:
    try:
        return format_of_name(path)
    except InputError:
        return None


def _recognised(module: ModuleType, head: bytes) -> bool:
    """True if nothing speaks against the format."""
    return not hasattr(module, "recognises") or bool(module.recognises(head))


def model_path(path: Path) -> Path:
    """The file in a folder that is a model, for the formats that have a name for it; else the path itself."""
    names = (suffix for suffix in suffixes() if not suffix.startswith("."))
    return next((path / name for name in names if is_file(path / name)), path)


def load(path: str | os.PathLike[str]) -> Gaussians:
    """Read a model file of any format. Raises InputError naming the file and the trouble."""
    path = model_path(Path(path))
    module = format_of(path)
    tell_kind(path, module)
    gaussians: Gaussians = module.read(path)
    if gaussians.near == NEAR:
        gaussians.near = _near_of(gaussians)
    return gaussians


def _near_of(gaussians: Gaussians) -> float:
    """The near plane of a model that comes without one: the usual, unless the model would be lost behind it."""
    some = gaussians.means[:: max(len(gaussians) // SAMPLED, 1)].astype(np.float64)
    size = float(np.median(np.linalg.norm(some - np.median(some, axis=0), axis=1)))
    return size / NEARS if 0 < size < SMALL * NEAR else NEAR


def save(path: str | os.PathLike[str], gaussians: Gaussians, **options: Any) -> None:
    """Write a model file, atomically, in the format of the name. options: of the format's `write`; those that it has
    not are passed over. Raises InputError for an ending that is not written."""
    write = format_of_name(path, writable=True).write
    known = inspect.signature(write).parameters
    write(Path(path), gaussians, **{name: value for name, value in options.items() if name in known})
