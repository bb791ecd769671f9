# SPDX-License-Identifier: Apache-2.0
"""Projections are one table, and what a splat and a ray share is one layout."""

from __future__ import annotations

import pickle
import re
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
import scenes

import clsplat
from clsplat.camera import CAMERA_MODELS, PROJECTIONS, Projection
from clsplat.device.source import kernel_root
from clsplat.layouts.columns import COUNTED, RAY, READBACK, REFUSED, SPLAT, header

PACKAGE = Path(clsplat.__file__).parent
KERNELS = "".join(path.read_text("utf-8") for path in kernel_root().rglob("*.[ch]*"))
NAME = re.compile("|".join(rf"""["']{name}["']""" for name in PROJECTIONS))
OTHER_MEANINGS = {
    "library/projection.py",  # the docstring of gsplat's argument camera_model, and the next three
    "library/rasterize.py",
    "torch/projection.py",
    "torch/rendering.py",
    "reference/ewa.py",  # the twin of gsplat's projection
    "demo/town/settings.py",  # cameras in the streets of a town
    "models/formats/usd.py",  # a hint of USD's about sorting
    "models/info.py",  # --perspective, as the model says it
    "runs/run.py",  # the name of that setting
}
"""Modules that have the name of a projection, and do not ask for a camera's."""


def test_every_projection_has_a_row() -> None:
    assert tuple(PROJECTIONS) == get_args(Projection)
    assert {model.projection for model in CAMERA_MODELS} == set(PROJECTIONS)
    defines = [tuple(model.defines.items()) for model in CAMERA_MODELS]
    assert len(set(defines)) == len(defines), "each is a build of its own"


def test_the_kernels_look_at_every_define() -> None:
    for model in CAMERA_MODELS:
        assert model.flat or model.along_rays
        for name in model.defines:
            assert re.search(rf"#\s*(if|ifdef|ifndef|elif)\b.*\b{name}\b", KERNELS), name


def test_the_kernels_ask_for_a_model_in_one_place() -> None:
    """Elsewhere they ask for properties, such as RAYS and ON_PLANE, which headers of shared/camera/ define."""
    named = {name for model in CAMERA_MODELS for name in model.defines} - {"RAYS", "BENT_FISHEYE"}
    asks = re.compile(rf"#\s*(if|ifdef|ifndef|elif)\b.*\b({'|'.join(named)})\b")
    asking = {path.name for path in kernel_root().rglob("*.[ch]*") if asks.search(path.read_text("utf-8"))}
    assert asking == {"camera.h"}


def test_other_rooms_do_not_compare_projections() -> None:
    naming = {
        path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py") if NAME.search(path.read_text("utf-8"))
    }
    assert naming - OTHER_MEANINGS == {"camera.py"}


@pytest.mark.parametrize("column", ["lenses", "transforms", "nerfstudio", "usd"])
def test_a_name_in_a_file_means_one_model(column: str) -> None:
    names = [name for model in CAMERA_MODELS for name in getattr(model, column)]
    assert len(set(names)) == len(names) > 0


def test_an_option_selects_its_model() -> None:
    camera = scenes.straight_camera(8, 8)
    for model in CAMERA_MODELS:
        chosen = {"": {}, "radial": {"radial": (0.1, 0.0, 0.0, 0.0)}, "by_rays": {"by_rays": True}}[model.option]
        made = replace(camera.through(model), **chosen)
        assert made.model is model
        assert pickle.loads(pickle.dumps(made)).model is model, "as it goes to another process"


def test_blending_reads_splats_and_rays_alike() -> None:
    """kernels/shared/alpha.h has one name for each, whichever it is."""
    assert len(SPLAT) == len(RAY)
    shared = set(SPLAT) & set(RAY)
    assert shared == {"LOG2O", "RED", "GREEN", "BLUE", "DEPTH"}
    assert {name: SPLAT.index(name) for name in shared} == {name: RAY.index(name) for name in shared}


def test_what_is_read_back_has_names_in_the_kernels() -> None:
    assert (*COUNTED, "STOPPED", *(f"REFUSED_{reason.upper()}" for reason in REFUSED)) == READBACK
    for place, name in enumerate(READBACK):
        assert f"#define READBACK_{name} {place}\n" in header()
        assert re.search(rf"\bREADBACK_{name}\b", KERNELS), name
