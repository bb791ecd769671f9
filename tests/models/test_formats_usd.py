# SPDX-License-Identifier: Apache-2.0
"""OpenUSD's ParticleField3DGaussianSplat: what comes back, what USD itself says of it, transforms, and damage."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import python, refuses
from needs import require
from quick import quick
from scipy.spatial.transform import Rotation
from splats import assert_refused_or_sound, assert_within, colours, covariances, damaged, lopsided, with_origin

from clsplat.errors import InputError
from clsplat.models.formats import format_of_name, usd
from clsplat.shots import read_shot

require("pxr")
from pxr import Gf, Sdf, Usd, UsdGeom  # noqa: E402

SUFFIXES = format_of_name("x.usd").suffixes
EXACT = {"means": 0, "rotations": 1e-6, "log_scales": 5e-7, "opacities": 2e-7, "sh0": 0, "sh": 0}
"""The rest is float32's rounding of unit quaternions, of exp and of the sigmoid."""


@pytest.mark.parametrize("suffix", quick(SUFFIXES, ".usda", ".usdc"))
def test_it_comes_back_as_it_was(tmp_path: Path, suffix: str) -> None:
    for degree in range(4):
        model, path = lopsided(100, degree), tmp_path / f"model{degree}{suffix}"
        usd.write(path, model)
        assert_within(usd.read(path), model, **EXACT)
    assert usd.describe(path) == {"up_axis": "Y", "meters_per_unit": 1.0}
    assert len(list(tmp_path.iterdir())) == 4


@pytest.mark.parametrize("suffix", quick([".usda", ".usdc", ".usdz"], ".usda", ".usdz"))
def test_a_folder_with_brackets_and_letters_of_any_kind(tmp_path: Path, suffix: str) -> None:
    """Layers in a package are named with brackets: PACKAGE[LAYER]."""
    folder = tmp_path / "take [1] ü日"
    folder.mkdir()
    usd.write(folder / f"a{suffix}", lopsided())
    assert_within(usd.read(folder / f"a{suffix}"), lopsided(), **EXACT)


@pytest.mark.parametrize("suffix", [".usda", ".usdz"])
def test_usd_has_nothing_against_it(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"model{suffix}"
    usd.write(path, with_origin(lopsided(), 4e5, 0, 1))
    validation = pytest.importorskip("pxr.UsdValidation", reason="this usd-core has no validators")
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10
    found = validation.ValidationContext(validators).Validate(Usd.Stage.Open(str(path)))
    assert not [each.GetErrorAsString() for each in found]


def test_the_stage_has_what_the_schema_asks_for(tmp_path: Path) -> None:
    model, path = lopsided(degree=2), tmp_path / "model.usdc"
    usd.write(path, model, up_axis="Z", meters_per_unit=0.5)
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 0.5
    prim = stage.GetPrimAtPath(usd.GAUSSIANS_PRIM_PATH)
    definition = prim.GetPrimDefinition()
    if not definition.GetPropertyNames():
        pytest.skip("this usd-core has no such schema")
    for attribute in prim.GetAuthoredAttributes():
        spec = definition.GetSchemaAttributeSpec(attribute.GetName())
        assert spec is not None, attribute.GetName()
        assert attribute.GetTypeName() == spec.typeName, attribute.GetName()
        assert attribute.GetVariability() == spec.variability, attribute.GetName()
    get: Any = lambda name: prim.GetAttribute(name).Get()  # noqa: E731
    np.testing.assert_array_equal(np.array(get("positions")), model.means)
    turn = Rotation.from_quat([[*q.GetImaginary(), q.GetReal()] for q in get("orientations")])
    wanted = Rotation.from_quat(model.quaternions[:, [1, 2, 3, 0]])
    assert (turn.inv() * wanted).magnitude().max() < 1e-6
    np.testing.assert_allclose(np.array(get("scales")), np.exp(model.log_scales), rtol=1e-6)
    np.testing.assert_allclose(np.array(get("opacities")), 1 / (1 + np.exp(-model.opacity_logits)), rtol=1e-6)
    assert get(usd.SH_DEGREE_ATTRIBUTE) == 2
    # "grouped by particle"
    np.testing.assert_array_equal(np.array(get(usd.SH_COEFFICIENTS_ATTRIBUTE)).reshape(-1, 9, 3), model.sh)
    low, high = np.array(get("extent"))
    assert (low < model.means.min(axis=0)).all() and (high > model.means.max(axis=0)).all()


def test_a_far_model_counts_from_the_prim_above(tmp_path: Path) -> None:
    model, path = with_origin(lopsided(), 4.5e5, 5.4e6, 123), tmp_path / "model.usdc"
    usd.write(path, model)
    stage = Usd.Stage.Open(str(path))
    world = UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetPrimAtPath(usd.GAUSSIANS_PRIM_PATH))
    assert world[3] == (4.5e5, 5.4e6, 123, 1)
    back = usd.read(path)
    np.testing.assert_array_equal(back.origin, model.origin)
    np.testing.assert_array_equal(back.means, model.means)


def test_prims_move_turn_and_scale(tmp_path: Path) -> None:
    model, path = lopsided(), tmp_path / "model.usda"
    usd.write(path, model)
    turn = Rotation.from_rotvec([0.3, -0.8, 0.5])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 2 * turn.as_matrix(), [1, 2, 3]
    stage = Usd.Stage.Open(str(path))
    UsdGeom.Xformable(stage.GetPrimAtPath(usd.WORLD_PRIM_PATH)).AddTransformOp().Set(Gf.Matrix4d(matrix.T))
    stage.GetRootLayer().Save()
    moved = usd.read(path)
    np.testing.assert_allclose(moved.means, 2 * model.means @ turn.as_matrix().T + [1, 2, 3], atol=1e-5)
    local = turn.as_matrix()
    np.testing.assert_allclose(covariances(moved), 4 * local @ covariances(model) @ local.T, rtol=1e-4, atol=1e-7)
    directions = np.random.default_rng(0).standard_normal((20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(colours(moved, directions @ local.T), colours(model, directions), atol=2e-6)


def test_halves_and_what_is_absent(tmp_path: Path) -> None:
    path = tmp_path / "model.usda"
    stage = Usd.Stage.CreateNew(str(path))
    prim = stage.DefinePrim("/Splats", usd.GAUSSIAN_PRIM_TYPES[1])  # the name of the draft
    prim.CreateAttribute("positionsh", Sdf.ValueTypeNames.Point3hArray).Set([(1, 2, 3), (4, 5, 6)])
    prim.CreateAttribute(usd.SH_DEGREE_ATTRIBUTE, Sdf.ValueTypeNames.Int).Set(0)
    prim.CreateAttribute(f"{usd.SH_COEFFICIENTS_ATTRIBUTE}h", Sdf.ValueTypeNames.Half3Array).Set(
        [(0.5, 0.25, 0), (1, 1, 1)]
    )
    stage.GetRootLayer().Save()
    model = usd.read(path)
    np.testing.assert_array_equal(model.means, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(model.quaternions, [[1, 0, 0, 0]] * 2)
    np.testing.assert_array_equal(model.log_scales, np.zeros((2, 3)))
    np.testing.assert_array_equal(model.sh, [[[0.5, 0.25, 0]], [[1, 1, 1]]])
    assert (model.opacity_logits > 16).all()


def test_layers_elsewhere_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "inside"
    folder.mkdir()
    usd.write(tmp_path / "model.usda", lopsided(5))
    (folder / "shot.usda").write_text("#usda 1.0\n(\n    subLayers = [@../model.usda@]\n)\n")
    refuses(r"shot\.usda: refers to .*model\.usda", usd.read, folder / "shot.usda")
    usd.write(folder / "model.usda", lopsided(5))
    (folder / "shot.usda").write_text("#usda 1.0\n(\n    subLayers = [@model.usda@]\n)\n")
    assert len(usd.read(folder / "shot.usda")) == 5


@pytest.mark.parametrize("suffix", quick(SUFFIXES[:3], ".usda"))
def test_damaged_files(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"model{suffix}"
    usd.write(path, lopsided(4, degree=0))
    refused = 0
    whole = path.read_bytes()
    for index, data in enumerate(damaged(whole, step=max(1, len(whole) // 60))):
        each = tmp_path / f"{index}{suffix}"  # USD keeps layers by their name
        each.write_bytes(data)
        refused += assert_refused_or_sound(usd.read_here, each)
        if index % 20 == 0:  # in a process of its own first, which takes a while
            with suppress(InputError):
                usd.describe(each)
    assert refused > 55  # the cuts


def test_a_file_that_crashes_the_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "model.usdc"
    usd.write(path, lopsided(4, degree=0))
    folder = tmp_path / "first" / "clsplat" / "models" / "formats"
    folder.mkdir(parents=True)
    for package in (folder.parent.parent, folder.parent, folder):
        (package / "__init__.py").write_text("")
    (folder / "usd.py").write_text("import os\n\n\ndef read_here(path):\n    os.abort()\n")
    monkeypatch.syspath_prepend(tmp_path / "first")  # of the other process
    for read in (usd.read, usd.describe):
        refuses(r"model\.usdc: crashes USD's library; is it damaged", read, path)


def too_deep(path: Path) -> Path:
    """USD's own parser goes down with each level until its stack ends."""
    path.write_text("#usda 1.0\n" + 'def "a" {\n' * 200_000 + 'def Camera "c" {}\n' + "}\n" * 200_000)
    return path


@pytest.mark.parametrize("damaged", ["in name", pytest.param("indeed", marks=pytest.mark.slow)])
def test_text_that_refers_to_others_is_tried_first(
    damaged: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if damaged == "indeed":
        too_deep(tmp_path / "damaged.usda")
    else:
        monkeypatch.setattr(usd, "_lives", lambda *_: False)
    path = tmp_path / "shot.usda"
    path.write_text("#usda 1.0\n(\n    subLayers = [@damaged.usda@]\n)\n")
    for read in (usd.read, lambda each: read_shot(each, size=(64, 48))):
        refuses(r"shot\.usda: crashes USD's library; is it damaged", read, path)


@pytest.mark.slow
def test_cameras_that_crash_the_library(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"deep\.usda: crashes USD's library"):
        read_shot(too_deep(tmp_path / "deep.usda"), size=(64, 48))


def test_text_that_stands_alone_is_read_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usd.write(tmp_path / "model.usda", lopsided(4, degree=0))
    monkeypatch.setattr(usd, "_lives", None)
    assert len(usd.read(tmp_path / "model.usda")) == 4


def test_values_of_another_kind_are_named(tmp_path: Path) -> None:
    """One number of each Gaussian is not called a row."""
    path = tmp_path / "model.usda"
    usd.write(path, lopsided(4, degree=0))
    text = path.read_text()
    for kind, name, expected in (("float", "opacities", "numbers"), ("float3", "scales", "rows of 3 numbers")):
        assert f"{kind}[] {name}" in text
        wrong = re.sub(
            rf"{re.escape(kind)}\[\] {name} = \[.*?\]", f"int[] {name} = [1, 2, 3, 4, 5]", text, flags=re.DOTALL
        )
        path.write_text(wrong)
        refuses(rf"{name} are int32 \(5,\), expected {expected}$", usd.read, path)


def test_a_stage_without_gaussians(tmp_path: Path) -> None:
    (tmp_path / "model.usda").write_text('#usda 1.0\ndef Xform "World" {}\n')
    refuses("has no ParticleField3DGaussianSplat", usd.read, tmp_path / "model.usda")
    refuses("no such file", usd.read, tmp_path / "missing.usda")


def test_without_usd_core_there_is_one_line(tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules['pxr'] = None\n"
        "from pathlib import Path\nfrom clsplat.models.formats import usd\n"
        f"usd.read(Path({str(tmp_path / 'model.usda')!r}))"
    )
    done = python("-c", code)
    assert "USD needs usd-core, which is not installed: pip install 'clsplat[usd]'" in done.stderr
