# SPDX-License-Identifier: Apache-2.0
"""Replacement of gsplat's names by clsplat's, for programs written for gsplat, and access to gsplat's strategies."""

from __future__ import annotations

import functools
import re
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from typing import Any

from torch import Tensor

from clsplat.errors import ClsplatError
from clsplat.torch.covariances import quat_scale_to_covar_preci
from clsplat.torch.gsplat import absent_names
from clsplat.torch.harmonics import spherical_harmonics
from clsplat.torch.pixels import rasterize_to_pixels
from clsplat.torch.projection import fully_fused_projection
from clsplat.torch.relocation import compute_relocation
from clsplat.torch.rendering import RollingShutterType, rasterization
from clsplat.torch.selective_adam import SelectiveAdam
from clsplat.torch.tiles import isect_offset_encode, isect_tiles

GSPLAT_VERSION = "1.5.3"
"""The version of gsplat whose interface clsplat implements."""
REPLACEMENTS_BY_MODULE: dict[str, tuple[Any, ...]] = {
    "gsplat.cuda._wrapper": (
        fully_fused_projection,
        isect_offset_encode,
        isect_tiles,
        quat_scale_to_covar_preci,
        rasterize_to_pixels,
        spherical_harmonics,
    ),
    "gsplat.optimizers.selective_adam": (SelectiveAdam,),
    "gsplat.relocation": (compute_relocation,),
    "gsplat.rendering": (rasterization,),
}
"""clsplat's functions and classes, by the gsplat module that defines the originals."""
GSPLAT_PACKAGES = ("gsplat", "gsplat.cuda", "gsplat.optimizers")
TWO_RADII_SINCE_VERSION = (1, 5)
"""The first version of gsplat in which a splat has two radii."""
FUNCTIONS_CHANGED_IN_1_5 = (fully_fused_projection, isect_tiles)
"""Functions whose results or arguments changed in gsplat 1.5, and which are not replaced in older versions."""


def install_as_gsplat() -> list[str]:
    """Let a program that imports gsplat run on clsplat.

    If gsplat is installed, its functions are replaced in all imported modules, gsplat's and the program's. CUDA
    functions that clsplat does not have raise InputError when they are called. gsplat's Python code is not replaced.
    For versions before 1.5, `meta["radii"]` of `rasterization` has one radius per splat, as their strategies expect.

    If gsplat is not installed, a module `gsplat` with clsplat's names is created. It has no strategies, and gsplat's
    other names in it raise an error. A second call does nothing.

    Returns
    -------
    list of str
        The names that now belong to clsplat.

    Notes
    -----
    gsplat 1.5.3 (Apache-2.0), https://github.com/nerfstudio-project/gsplat.
    """
    if not _has("gsplat"):
        return _make_package()
    old = _version(import_module("gsplat")) < TWO_RADII_SINCE_VERSION
    homes = {
        home: [each for each in given if not (old and each in FUNCTIONS_CHANGED_IN_1_5)]
        for home, given in REPLACEMENTS_BY_MODULE.items()
    }
    replaced: dict[int, tuple[Any, Any]] = {}
    for home, given in homes.items():
        module = import_module(home) if _has(home) else None
        for ours in given:
            theirs = getattr(module, ours.__name__, None)
            if theirs is not None and not _is_ours(theirs):
                replaced[id(theirs)] = (theirs, _with_one_radius(ours) if old and ours is rasterization else ours)
    for home in filter(_has, absent_names.CUDA_ONLY_MODULES):
        for name in absent_names.CUDA_ONLY_NAMES:
            theirs = getattr(import_module(home), name, None)
            if theirs is not None and not absent_names.is_refused(theirs):
                replaced[id(theirs)] = (theirs, absent_names.refuses(name, theirs))
    names = []
    for module_name, module in list(sys.modules.items()):
        for name, value in list(getattr(module, "__dict__", {}).items()):
            theirs, ours = replaced.get(id(value), (None, None))
            if theirs is not None and theirs is value:
                setattr(module, name, ours)
                names += [] if absent_names.is_refused(ours) else [f"{module_name}.{name}"]
    return sorted(names)


def strategy(name: str) -> Any:
    """Return a class of `gsplat.strategy`, with clsplat's replacements for the functions that need CUDA.

    Raises ImportError if gsplat is not installed, ClsplatError if it is older than 1.5.
    """
    if not _has("gsplat") or not _has("gsplat.strategy"):
        raise ImportError(_own(name))
    if (found := _version(import_module("gsplat"))) < TWO_RADII_SINCE_VERSION:
        raise ClsplatError(
            f"gsplat is version {'.'.join(map(str, found))}, but {name} needs 1.5 or later: use install_as_gsplat()"
        )
    operations = import_module("gsplat.strategy.ops")
    for ours in (quat_scale_to_covar_preci, compute_relocation):
        setattr(operations, ours.__name__, ours)
    return getattr(import_module("gsplat.strategy"), name)


def _of_gsplat(place: str, name: str) -> Any:
    """Return the attribute `name` of `place`, a module that `_make_package` created without this attribute.

    For a function that needs CUDA, the result is a function that raises InputError; for a strategy, gsplat's class.
    Raises ImportError if the name needs gsplat, which is not installed, and AttributeError for other names.
    """
    if name in absent_names.CUDA_ONLY_NAMES:
        return absent_names.refuses(name)
    if place == "gsplat" and name in {"DefaultStrategy", "MCMCStrategy"}:
        return strategy(name)
    if place == "gsplat" and name in absent_names.PURE_PYTHON_NAMES:
        raise ImportError(_own(name))
    raise AttributeError(f"module {place!r} has no attribute {name!r}; clsplat.torch replaces gsplat here")


def _own(name: str) -> str:
    return f"{name} is part of gsplat, expected gsplat to be installed: pip install --no-deps gsplat=={GSPLAT_VERSION}"


def _has(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # a parent package of the module is missing
        return False


def _version(module: ModuleType) -> tuple[int, ...]:
    numbers = re.match(r"(\d+)\.(\d+)", str(getattr(module, "__version__", GSPLAT_VERSION)))
    return tuple(int(part) for part in numbers.groups()) if numbers else TWO_RADII_SINCE_VERSION


def _is_ours(value: Any) -> bool:
    return str(getattr(value, "__module__", "")).startswith("clsplat.torch")


def _with_one_radius(function: Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]) -> Callable[..., Any]:
    """Wrap `rasterization` so that it returns one radius per splat, as before gsplat 1.5: the larger of the two radii.

    The radii in `meta` become (C, N), or (nnz,) if packed.
    """

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
        images, alphas, meta = function(*args, **kwargs)
        meta["radii"] = meta["radii"].amax(-1)
        return images, alphas, meta

    return call


def _make_package() -> list[str]:
    """Create the module `gsplat` and its submodules in `sys.modules`."""
    names = []
    for home in sorted({*GSPLAT_PACKAGES, *REPLACEMENTS_BY_MODULE}):
        module = ModuleType(home, "clsplat.torch in the place of gsplat.")
        module.__spec__ = ModuleSpec(home, None, is_package=home in GSPLAT_PACKAGES)
        if home in GSPLAT_PACKAGES:
            module.__path__ = []
        sys.modules[home] = module
        parent, _, last = home.rpartition(".")
        if parent:
            setattr(sys.modules[parent], last, module)
    for home, given in REPLACEMENTS_BY_MODULE.items():
        for ours in given:
            places = {home, "gsplat"} | ({home.rpartition(".")[0]} if "optimizers" in home else set())
            if ours is compute_relocation:
                places.discard("gsplat")  # gsplat's top-level package lacks the function
            for place in places:
                setattr(sys.modules[place], ours.__name__, ours)
                names.append(f"{place}.{ours.__name__}")
    for place in ("gsplat", "gsplat.cuda._wrapper"):
        sys.modules[place].RollingShutterType = RollingShutterType  # type: ignore[attr-defined]
    for place in ("gsplat", "gsplat.rendering", "gsplat.cuda._wrapper"):
        sys.modules[place].__getattr__ = functools.partial(_of_gsplat, place)  # type: ignore[method-assign]
    sys.modules["gsplat"].__version__ = GSPLAT_VERSION  # type: ignore[attr-defined]
    return sorted(names)
