# SPDX-License-Identifier: Apache-2.0
"""Instances of Gaussians that a stage's PointInstancers place, against stages that have a prim for each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import Capture, rejected
from compare import assert_same_bits
from needs import require
from rendered import pixels_of
from tiny import WIDTH, hidden_model
from usd_stages import saved, stage_with_camera

from clsplat.arrays import Float32, Float64
from clsplat.cli.main import main
from clsplat.models import edit
from clsplat.models.formats import load, usd
from clsplat.shots.usd_models import StageModels, read_stage

require("pxr")
from pxr import Gf, Sdf, Usd, UsdGeom  # noqa: E402

MODEL = edit.take(hidden_model(), slice(12))
EVERYTHING = "--channels rgb,alpha,motion,id --shutter-angle 180 --samples 4 --exr float"


@pytest.fixture(autouse=True)
def no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stages of these tests do not end the process, so that none has to try them first."""
    monkeypatch.setattr(usd, "_lives", lambda *_: True)


def new_stage(folder: Path, name: str) -> Usd.Stage:
    """A stage of frames 1 to 5 with a camera; the model is a file beside it."""
    if not (folder / "model.usdc").exists():
        usd.write(folder / "model.usdc", MODEL)
    return stage_with_camera(folder / f"{name}.usda")


def with_model(stage: Usd.Stage, path: str) -> Any:
    prim = UsdGeom.Xform.Define(stage, path).GetPrim()
    prim.GetReferences().AddReference("./model.usdc")
    return prim


def instancer(stage: Usd.Stage, path: str, prototypes: list[str], indices: list[int]) -> Any:
    made = UsdGeom.PointInstancer.Define(stage, path)
    for prototype in prototypes:
        made.CreatePrototypesRel().AddTarget(prototype)
    made.CreateProtoIndicesAttr(indices)
    return made


def pixels(stage: Usd.Stage, frame: int, flags: str = "") -> Float32:
    path = Path(saved(stage))
    out = path.parent / path.stem
    words = ["render", str(path), "--cameras", str(path), "-o", str(out / "####.exr"), "--frames", str(frame)]
    assert main([*words, "--progress", "none", "--width", str(WIDTH), "--overwrite", *flags.split()]) == 0
    return pixels_of(out / f"{frame:04d}.exr")


def tracks(stage: Usd.Stage) -> dict[str, Any]:
    """The tracks of a stage by the names of its places."""
    models = read_stage(Path(saved(stage)))
    assert isinstance(models, StageModels)
    return dict(zip(models.names, models.tracks, strict=True))


def shift_of(track: Any, frame: float) -> tuple[list[float], float]:
    """Its translation and its opacity."""
    place = track.at(frame)
    matrix: Float64 = place.transform
    return np.round(matrix[:3, 3], 6).tolist(), place.opacity


def test_a_hundred_instances_are_a_hundred_prims(tmp_path: Path) -> None:
    """Each with its own translation, rotation and scale over time, in motion blur and in the motion channel."""
    rng = np.random.default_rng(3)
    count, times = 100, (1, 3, 5)
    shifts = {time: [Gf.Vec3f(*row) for row in rng.uniform(-1.5, 1.5, (count, 3)).tolist()] for time in times}
    turns = {time: [Gf.Quatf(*row).GetNormalized() for row in rng.normal(size=(count, 4)).tolist()] for time in times}
    scales = {time: [Gf.Vec3f(size) for size in rng.uniform(0.1, 0.4, count).tolist()] for time in times}
    placed = new_stage(tmp_path, "placed")
    UsdGeom.Xform.Define(placed, "/Set").AddTranslateOp().Set(Gf.Vec3d(0.25, 0, 0))
    with_model(placed, "/Set/Forest/Tree")
    forest = instancer(placed, "/Set/Forest", ["/Set/Forest/Tree"], [0] * count)
    orientations = forest.CreateOrientationsfAttr()
    for time in times:
        forest.CreatePositionsAttr().Set(shifts[time], time)
        orientations.Set(turns[time], time)
        forest.CreateScalesAttr().Set(scales[time], time)
    prims = new_stage(tmp_path, "prims")
    UsdGeom.Xform.Define(prims, "/Set").AddTranslateOp().Set(Gf.Vec3d(0.25, 0, 0))
    for index in range(count):
        prim = UsdGeom.Xformable(with_model(prims, f"/Set/Tree{index}"))
        shift = prim.AddTranslateOp(UsdGeom.XformOp.PrecisionFloat)
        turn, scale = prim.AddOrientOp(UsdGeom.XformOp.PrecisionFloat), prim.AddScaleOp()
        for time in times:
            shift.Set(shifts[time][index], time)
            turn.Set(turns[time][index], time)
            scale.Set(scales[time][index], time)
    for frame, flags in ((1, "--channels rgb,alpha"), (2, EVERYTHING)):
        wanted = pixels(prims, frame, flags)
        assert wanted[:, :, 3].any()
        assert_same_bits(pixels(placed, frame, flags), wanted)


def test_instances_within_instances_and_prototypes_of_several_prims(tmp_path: Path) -> None:
    """A prototype that is but an `over`, of two prims, one of which is an instancer; and one that lies elsewhere."""
    placed = new_stage(tmp_path, "placed")
    placed.OverridePrim("/Field/Bush")
    with_model(placed, "/Field/Bush/Stem")
    UsdGeom.Xformable(placed.GetPrimAtPath("/Field/Bush/Stem")).AddScaleOp().Set(Gf.Vec3f(0.5))
    with_model(placed, "/Leaf")
    leaves = instancer(placed, "/Field/Bush/Leaves", ["/Leaf"], [0, 0])
    leaves.CreatePositionsAttr([(0, 0.5, 0), (0, -0.5, 0)])
    leaves.CreateScalesAttr([(0.25, 0.25, 0.25)] * 2)
    turn = Gf.Quath(0.8, 0.36, 0.48, 0)  # halves, of which none has the length 1
    leaves.CreateOrientationsAttr([turn] * 2)
    field = instancer(placed, "/Field", ["/Field/Bush"], [0, 0])
    field.CreatePositionsAttr().Set([(0, 0, 0), (1, 0, 0)], 1)
    field.CreatePositionsAttr().Set([(-1, 0, 0), (2, 0, 0)], 5)
    bush = placed.GetRootLayer().GetPrimAtPath("/Field/Bush")
    bush.specifier = Sdf.SpecifierOver  # again, as what is in it has made it a def
    found = tracks(placed)
    inner = [f"/Field[{bush}]/{part}/Gaussians" for bush in (0, 1) for part in ("Stem", "Leaves[0]", "Leaves[1]")]
    assert list(found) == [*inner, "/Leaf/Gaussians"]
    assert shift_of(found["/Field[1]/Leaves[1]/Gaussians"], 3) == ([1.5, -0.5, 0], 1)
    assert shift_of(found["/Field[0]/Stem/Gaussians"], 2) == ([-0.25, 0, 0], 1)
    prims = new_stage(tmp_path, "prims")
    for index, (start, end) in enumerate(((0, -1), (1, 2))):
        top = UsdGeom.Xform.Define(prims, f"/Bush{index}").AddTranslateOp()
        top.Set(Gf.Vec3d(start, 0, 0), 1)
        top.Set(Gf.Vec3d(end, 0, 0), 5)
        for name, height, size in (("Stem", 0, 0.5), ("Up", 0.5, 0.25), ("Down", -0.5, 0.25)):
            part = UsdGeom.Xformable(with_model(prims, f"/Bush{index}/{name}"))
            part.AddTranslateOp().Set(Gf.Vec3d(0, height, 0))
            if height:
                part.AddOrientOp(UsdGeom.XformOp.PrecisionHalf).Set(turn)
            part.AddScaleOp().Set(Gf.Vec3f(size))
    with_model(prims, "/Leaf")
    assert_same_bits(pixels(placed, 3, EVERYTHING), pixels(prims, 3, EVERYTHING))


def test_instances_appear_vanish_and_are_hidden(tmp_path: Path) -> None:
    """By their ids, whatever their rows are; in the middle of a frame they are where they were or will be."""
    stage = new_stage(tmp_path, "placed")
    with_model(stage, "/Forest/Tree")
    with_model(stage, "/Forest/Bush")
    forest = instancer(stage, "/Forest", ["/Forest/Tree", "/Forest/Bush"], [])
    ids, indices, positions = forest.CreateIdsAttr(), forest.GetProtoIndicesAttr(), forest.CreatePositionsAttr()
    for time, own, kinds, row in ((1, [7, 8], [0, 1], [1, 2]), (3, [9, 8], [0, 1], [4, 3])):
        ids.Set(own, time)
        indices.Set(kinds, time)
        positions.Set([(x, 0, 0) for x in row], time)
    forest.CreateInvisibleIdsAttr().Set([], 1)
    forest.GetInvisibleIdsAttr().Set([8], 2)
    forest.GetInvisibleIdsAttr().Set([], 3)
    found = tracks(stage)
    assert list(found) == [f"/Forest[{number}]/Gaussians" for number in (7, 8, 9)]
    seven, eight, nine = found.values()
    assert shift_of(seven, 1) == ([1, 0, 0], 1) and shift_of(seven, 4) == ([1, 0, 0], 0)
    assert [shift_of(eight, time)[1] for time in (1, 2, 3)] == [1, 0, 1]
    assert shift_of(eight, 4) == ([3, 0, 0], 1)
    assert shift_of(nine, 1) == ([4, 0, 0], 0) and shift_of(nine, 3) == ([4, 0, 0], 1)


def test_instances_follow_their_velocities(tmp_path: Path) -> None:
    """Units a second, from the last sample on, beyond the shot's ends too."""
    stage = new_stage(tmp_path, "placed")
    stage.SetTimeCodesPerSecond(10)
    with_model(stage, "/Forest/Tree")
    forest = instancer(stage, "/Forest", ["/Forest/Tree"], [0])
    for time, place, speed in ((1, 0.0, 10.0), (2, 1.0, 20.0)):
        forest.CreatePositionsAttr().Set([(place, 0, 0)], time)
        forest.CreateVelocitiesAttr().Set([(speed, 0, 0)], time)
    (track,) = tracks(stage).values()
    assert [shift_of(track, time)[0][0] for time in (1.25, 2, 2.25, 4)] == [0.25, 1, 1.5, 5]
    assert track.reach == (-np.inf, np.inf)


def test_what_stays_undrawn_is_one_warning(tmp_path: Path, capsys: Capture) -> None:
    stage = new_stage(tmp_path, "placed")
    for name in ("Tree", "Unused"):
        with_model(stage, f"/Forest/{name}")
    UsdGeom.Mesh.Define(stage, "/Forest/Rock")
    UsdGeom.Mesh.Define(stage, "/Hidden").MakeInvisible()
    UsdGeom.Mesh.Define(stage, "/Proxy").CreatePurposeAttr("proxy")
    UsdGeom.Points.Define(stage, "/Dust")
    stage.DefinePrim("/Lost").GetReferences().AddReference("./gone.usdc")
    forest = instancer(stage, "/Forest", ["/Forest/Tree", "/Forest/Unused", "/Forest/Rock"], [0, 2, 0])
    forest.CreatePositionsAttr([(0, 0, 0), (1, 0, 0), (0.5, 0.25, 0)])
    pixels(stage, 1)
    path = saved(stage)
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "not drawn" in line]
    assert line.endswith(
        f"{path}: not drawn: /Lost (its {tmp_path}/gone.usdc cannot be opened), /Forest/Unused/Gaussians (which no "
        "instance of /Forest draws), /Forest/Rock (Mesh) and 1 more; only ParticleField3DGaussianSplat prims "
        "of a stage are drawn"
    )
    found = edit.merge([edit.transform(load(tmp_path / "model.usdc"), shifted(x, y)) for x, y in ((0, 0), (0.5, 0.25))])
    stage.RemovePrim("/Lost")
    stage.Flatten().Export(str(tmp_path / "flat.usda"))
    np.testing.assert_array_equal(load(tmp_path / "flat.usda").means, found.means)


def shifted(x: float, y: float) -> Float64:
    matrix = np.eye(4)
    matrix[:2, 3] = x, y
    return matrix


def test_wrong_instancers_are_one_line(tmp_path: Path, capsys: Capture) -> None:
    def error_of(stage: Usd.Stage) -> str:
        path = saved(stage)
        return rejected(capsys, ["render", path, "--cameras", path, "-o", f"{tmp_path}/out.####.exr", "--width", "9"])

    stage = new_stage(tmp_path, "indices")
    with_model(stage, "/Forest/Tree")
    forest = instancer(stage, "/Forest", ["/Forest/Tree"], [0, 1])
    assert "/Forest: has the protoIndex 1, expected 0 to 0, as it has 1 prototypes" in error_of(stage)
    forest.GetProtoIndicesAttr().Set([0, 0])
    forest.CreatePositionsAttr([(0, 0, 0)])
    assert "has 2 protoIndices, expected as many positions" in error_of(stage)
    forest.GetPrototypesRel().SetTargets(["/Forest/Gone"])
    assert "/Forest: has the prototype /Forest/Gone, expected an existing prim" in error_of(stage)
    stage = new_stage(tmp_path, "loop")
    with_model(stage, "/A/Forest/Tree")
    instancer(stage, "/A/Forest", ["/A"], [0]).CreatePositionsAttr([(0, 0, 0)])
    assert "/A/Forest: is inside its own prototype" in error_of(stage).replace("/A/Forest[0]/Forest", "/A/Forest")
    stage = new_stage(tmp_path, "none")
    with_model(stage, "/Forest/Tree")
    instancer(stage, "/Forest", ["/Forest/Tree"], [])
    assert "has no ParticleField3DGaussianSplat that is drawn" in error_of(stage)
