# SPDX-License-Identifier: Apache-2.0
"""glTF with KHR_gaussian_splatting: what comes back, what others write and find, nodes, and damage."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import refuses, warned
from node import splat_transform, validate_gltf
from scipy.spatial.transform import Rotation
from splats import (
    assert_refused_or_sound,
    assert_within,
    colours,
    covariances,
    lopsided,
    refused_of,
    with_origin,
)
from systems import can_link

from clsplat.gaussians import Gaussians
from clsplat.models.formats import gltf, spz

EXACT = {"means": 0, "rotations": 1e-6, "log_scales": 5e-7, "opacities": 2e-7, "sh0": 0, "sh": 0}
"""The rest is float32's rounding of unit quaternions, of exp and of the sigmoid."""
TURN = np.diag([-1.0, -1.0, 1.0])


def document(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(path.read_text())
    return found


def changed(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    asset = document(path)
    change(asset)
    path.write_text(json.dumps(asset))


@pytest.mark.parametrize("name", ["model.glb", "model.gltf"])
@pytest.mark.parametrize("degree", range(4))
def test_it_comes_back_as_it_was(tmp_path: Path, name: str, degree: int) -> None:
    model, path = lopsided(degree=degree), tmp_path / name
    gltf.write(path, model)
    assert_within(gltf.read(path), model, **EXACT)
    assert gltf.describe(path) == {"color_space": "srgb_rec709_display", "compression": "none"}
    first = path.read_bytes()
    gltf.write(path, model)
    assert path.read_bytes() == first


def test_the_validator_knows_all_but_the_extension(tmp_path: Path) -> None:
    model = lopsided()
    model.save(tmp_path / "model.ply")
    splat_transform(tmp_path / "model.ply", tmp_path / "theirs.glb")
    gltf.write(tmp_path / "ours.glb", model)
    gltf.write(tmp_path / "ours.gltf", with_origin(model, 5e5, 1, -2))
    gltf.write(tmp_path / "packed.glb", model, spz_compression=True)
    # the newest validator does not know the extension yet, and so not the names of its attributes
    unknown = {"UNSUPPORTED_EXTENSION", "MESH_PRIMITIVE_INVALID_ATTRIBUTE"}
    assert {each["code"] for each in validate_gltf(tmp_path / "theirs.glb")} == unknown
    for name in ("ours.glb", "ours.gltf"):
        found = validate_gltf(tmp_path / name)
        assert {each["code"] for each in found} == unknown, found
        assert all("KHR_gaussian_splatting" in each["pointer"] + each["message"] for each in found), found
    found = validate_gltf(tmp_path / "packed.glb")
    assert {each["code"] for each in found if each["severity"] < 2} <= unknown, found


def test_what_another_writes_is_the_same_model(tmp_path: Path) -> None:
    model = lopsided()
    model.save(tmp_path / "model.ply")
    splat_transform(tmp_path / "model.ply", tmp_path / "theirs.glb")
    theirs = gltf.read(tmp_path / "theirs.glb")
    assert_within(theirs, model, **EXACT | {"rotations": 4})
    # it turns the quaternion alone, we the Gaussian's own axes too: the same ellipsoids, within float32
    np.testing.assert_allclose(covariances(theirs), covariances(model), rtol=1e-5, atol=1e-8)
    gltf.write(tmp_path / "ours.glb", model)
    ours, other = (gltf_positions(tmp_path / name) for name in ("ours.glb", "theirs.glb"))
    np.testing.assert_array_equal(ours, other)


def gltf_positions(path: Path) -> np.ndarray:
    """The first accessor of a .glb, read by nothing of ours."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    asset = json.loads(data[20 : 20 + length])
    index = asset["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
    view = asset["bufferViews"][asset["accessors"][index]["bufferView"]]
    start = 28 + length + view.get("byteOffset", 0)
    return np.frombuffer(data[start : start + view["byteLength"]], "<f4").reshape(-1, 3)


def test_up_is_up(tmp_path: Path) -> None:
    """glTF: +y up, +z forward, -x right; ours: y down, z forward, x right."""
    model = lopsided(3)
    model.means[:] = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    gltf.write(tmp_path / "model.glb", model)
    np.testing.assert_array_equal(gltf_positions(tmp_path / "model.glb"), [[-1, 0, 0], [0, -1, 0], [0, 0, 1]])


def test_a_far_model_counts_from_its_node(tmp_path: Path) -> None:
    model, path = with_origin(lopsided(), 4.5e5, 5.4e6, 123), tmp_path / "model.gltf"
    gltf.write(path, model)
    assert document(path)["nodes"][0]["translation"] == [-4.5e5, -5.4e6, 123]
    back = gltf.read(path)
    np.testing.assert_array_equal(back.origin, model.origin)
    np.testing.assert_array_equal(back.means, model.means)


def test_nodes_move_turn_and_scale(tmp_path: Path) -> None:
    model, path = lopsided(), tmp_path / "model.gltf"
    gltf.write(path, model)
    inner, outer = Rotation.from_rotvec([0.3, -0.8, 0.5]), Rotation.from_rotvec([1.0, 0.2, 0.1])

    def nest(asset: dict[str, Any]) -> None:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = 2 * outer.as_matrix(), [1, 2, 3]
        asset["nodes"] = [
            {"children": [1], "matrix": matrix.T.ravel().tolist()},
            {"mesh": 0, "rotation": inner.as_quat().tolist(), "scale": [1.5] * 3, "translation": [4, 5, 6]},
        ]

    changed(path, nest)
    moved = gltf.read(path)
    turn = (outer * inner).as_matrix()
    # in glTF's axes, where the matrices are
    wanted = 2 * (model.means @ TURN @ inner.as_matrix().T * 1.5 + [4, 5, 6]) @ outer.as_matrix().T + [1, 2, 3]
    np.testing.assert_allclose(moved.means @ TURN, wanted, atol=1e-5)
    local = TURN @ turn @ TURN
    np.testing.assert_allclose(covariances(moved), 9 * local @ covariances(model) @ local.T, rtol=1e-4, atol=1e-7)
    directions = np.random.default_rng(0).standard_normal((20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(colours(moved, directions @ local.T), colours(model, directions), atol=2e-6)


@pytest.mark.parametrize(
    "node", [{"scale": [1, 2, 1]}, {"scale": [-1, 1, 2]}, {"scale": [0, 0, 0]}, {"rotation": [0] * 4}]
)
def test_nodes_that_no_gaussian_can_follow(tmp_path: Path, node: dict[str, Any]) -> None:
    path = tmp_path / "model.gltf"
    gltf.write(path, lopsided(5))
    changed(path, lambda asset: asset["nodes"][0].update(node))
    refuses(r"model\.gltf: .*(a transform that (is no|cannot be)|rotation of node 0 is 0)", gltf.read, path)


def test_a_node_that_mirrors(tmp_path: Path) -> None:
    model, path = lopsided(30), tmp_path / "model.gltf"
    gltf.write(path, model)
    changed(path, lambda asset: asset["nodes"][0].update(scale=[-2, 2, 2]))
    moved, mirror = gltf.read(path), np.diag([-1.0, 1.0, 1.0])
    np.testing.assert_allclose(moved.means, 2 * model.means @ mirror, rtol=1e-6)
    np.testing.assert_allclose(covariances(moved), 4 * mirror @ covariances(model) @ mirror, rtol=1e-4, atol=1e-7)
    directions = np.random.default_rng(0).standard_normal((20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(colours(moved, directions @ mirror), colours(model, directions), atol=2e-6)


def test_several_primitives_are_one_model(tmp_path: Path) -> None:
    model, path = lopsided(40, degree=2), tmp_path / "model.gltf"
    gltf.write(path, model)

    def double(asset: dict[str, Any]) -> None:
        asset["nodes"] = [{"mesh": 0}, {"mesh": 1, "translation": [1, 0, 0]}]
        asset["scenes"] = [{"nodes": [0, 1]}]
        (primitive,) = asset["meshes"][0]["primitives"]
        flat = {name: index for name, index in primitive["attributes"].items() if "_2_" not in name}
        asset["meshes"] += [{"primitives": [primitive | {"attributes": flat}]}]

    changed(path, double)
    both = gltf.read(path)
    assert len(both) == 80
    np.testing.assert_array_equal(both.means[:40], model.means)
    np.testing.assert_allclose(both.means[40:], model.means - np.float32([1, 0, 0]), atol=1e-6)
    assert not both.sh[40:, 4:].any()


def test_a_buffer_in_the_document(tmp_path: Path) -> None:
    model, path = lopsided(20), tmp_path / "model.gltf"
    gltf.write(path, model)
    data = base64.b64encode((tmp_path / "model.bin").read_bytes()).decode()
    (tmp_path / "model.bin").unlink()
    changed(path, lambda asset: asset["buffers"][0].update(uri=f"data:application/octet-stream;base64,{data}"))
    assert_within(gltf.read(path), model, **EXACT)


@pytest.mark.parametrize(
    "uri", ["../secret.bin", "/etc/hostname", "file:///etc/hostname", "//host/x", "%2e%2e/secret.bin"]
)
def test_no_buffer_is_outside_the_folder(tmp_path: Path, uri: str) -> None:
    folder = tmp_path / "inside"
    folder.mkdir()
    path = folder / "model.gltf"
    gltf.write(path, lopsided(5))
    (folder / "model.bin").rename(tmp_path / "secret.bin")
    changed(path, lambda asset: asset["buffers"][0].update(uri=uri))
    refuses("expected a file in its folder or below it", gltf.read, path)
    if not can_link():
        return  # there is nothing to follow
    (folder / "link.bin").symlink_to(tmp_path / "secret.bin")
    changed(path, lambda asset: asset["buffers"][0].update(uri="link.bin"))
    refuses("expected a file in its folder or below it", gltf.read, path)


def test_normalised_integers_and_strides(tmp_path: Path) -> None:
    model, path = lopsided(10, degree=0), tmp_path / "model.gltf"
    gltf.write(path, model)
    rotation = np.array([[0, 0, 127, 0], [127, 0, 0, 0]] * 5, np.int8)
    opacity = np.array([[0, 255, 9, 9], [255, 0, 9, 9]] * 5, np.uint8)  # two bytes of four
    extra = rotation.tobytes() + opacity.tobytes()

    def quantise(asset: dict[str, Any]) -> None:
        start = asset["buffers"][0]["byteLength"]
        asset["buffers"][0]["byteLength"] += len(extra)
        views, accessors = asset["bufferViews"], asset["accessors"]
        views += [
            {"buffer": 0, "byteOffset": start, "byteLength": 40},
            {"buffer": 0, "byteOffset": start + 40, "byteLength": 40, "byteStride": 4},
        ]
        accessors[1].update(bufferView=len(views) - 2, componentType=5120, normalized=True)
        accessors[3].update(bufferView=len(views) - 1, byteOffset=1, componentType=5121, normalized=True)

    changed(path, quantise)
    with (tmp_path / "model.bin").open("ab") as file:
        file.write(extra)
    back = gltf.read(path)
    np.testing.assert_array_equal(back.quaternions, [[0, 0, 0, 1], [0, -1, 0, 0]] * 5)
    np.testing.assert_allclose(1 / (1 + np.exp(-back.opacity_logits)), [1, 0] * 5, atol=1e-7)


def test_spz_in_a_buffer(tmp_path: Path) -> None:
    model, path = with_origin(lopsided(), 3e5, 0, 0), tmp_path / "model.glb"
    gltf.write(path, model, spz_compression=True)
    assert gltf.describe(path)["compression"] == gltf.SPZ_EXTENSION
    spz.write(tmp_path / "model.spz", lopsided(), version=2)
    back, alone = gltf.read(path), spz.read(tmp_path / "model.spz")
    np.testing.assert_array_equal(back.origin, model.origin)
    np.testing.assert_array_equal(back.means, alone.means)
    np.testing.assert_array_equal(back.sh, alone.sh)


def test_linear_colours_are_said_to_be(tmp_path: Path) -> None:
    gltf.write(tmp_path / "model.glb", lopsided(5), color_space="lin_rec709_display")
    warned("lin_rec709_display", gltf.read, tmp_path / "model.glb")


def test_damaged_files(tmp_path: Path) -> None:
    for options in ({}, {"spz_compression": True}):
        path = tmp_path / "model.glb"
        gltf.write(path, lopsided(8, degree=1), **options)
        assert refused_of(gltf.read, path, step=17) > 100
    gltf.write(tmp_path / "model.gltf", lopsided(8, degree=0))
    assert refused_of(gltf.read, tmp_path / "model.gltf", step=11) > 100


Change = Callable[[dict[str, Any]], object]
LIES: dict[str, Change] = {
    "count": lambda asset: asset["accessors"][0].update(count=1 << 40),
    "other count": lambda asset: asset["accessors"][0].update(count=2),
    "negative": lambda asset: asset["accessors"][0].update(count=-1),
    "text": lambda asset: asset["accessors"][0].update(byteOffset="1"),
    "true": lambda asset: asset["accessors"][0].update(byteOffset=True),
    "offset": lambda asset: asset["bufferViews"][0].update(byteOffset=1 << 50),
    "length": lambda asset: asset["buffers"][0].update(byteLength=1 << 50),
    "stride": lambda asset: asset["bufferViews"][0].update(byteStride=1),
    "type": lambda asset: asset["accessors"][0].update(type="MAT4"),
    "component": lambda asset: asset["accessors"][0].update(componentType=7),
    "sparse": lambda asset: asset["accessors"][0].update(sparse={}),
    "cycle": lambda asset: asset["nodes"][0].update(children=[0]),
    "node": lambda asset: asset.update(nodes=[]),
    "scene": lambda asset: asset.update(scenes={"nodes": 3}),
    "mesh": lambda asset: asset["nodes"][0].update(mesh=None),
    "matrix": lambda asset: asset["nodes"][0].update(matrix=[1e999] * 16),
    "required": lambda asset: asset.update(extensionsRequired=["KHR_draco_mesh_compression"]),
    "required object": lambda asset: asset.update(extensionsRequired=[{}]),
    "version": lambda asset: asset["asset"].update(version="1.0"),
    "no version": lambda asset: asset.pop("asset"),
    "attribute": lambda asset: asset["meshes"][0]["primitives"][0]["attributes"].pop("KHR_gaussian_splatting:SCALE"),
    "half a band": lambda asset: asset["meshes"][0]["primitives"][0]["attributes"].pop(
        "KHR_gaussian_splatting:SH_DEGREE_1_COEF_1"
    ),
    "no splats": lambda asset: asset["meshes"][0]["primitives"][0].pop("extensions"),
    "bomb": lambda asset: asset.update(nodes=[{"mesh": 0}] * 200_000, scenes=[{"nodes": list(range(200_000))}]),
}


@pytest.mark.parametrize("lie", LIES)
def test_lies(tmp_path: Path, lie: str) -> None:
    path = tmp_path / "model.gltf"
    gltf.write(path, lopsided(8, degree=1))
    changed(path, LIES[lie])
    assert assert_refused_or_sound(gltf.read, path)


@pytest.mark.parametrize(
    ("accessor", "change", "message"),
    [
        (3, {"type": "VEC2"}, "KHR_gaussian_splatting:OPACITY has the type VEC2, expected SCALAR"),
        (0, {"type": "MAT4"}, "POSITION has the type MAT4, expected VEC3"),
        (1, {"type": "VEC3"}, "KHR_gaussian_splatting:ROTATION has the type VEC3, expected VEC4"),
        (2, {"componentType": 5124}, "KHR_gaussian_splatting:SCALE has the componentType 5124, expected 5120-5123"),
    ],
)
def test_an_accessor_of_another_type_is_told_as_gltf_says_it(
    accessor: int, change: dict[str, Any], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "model.gltf"
    gltf.write(path, lopsided(8, degree=1))
    changed(path, lambda asset: asset["accessors"][accessor].update(change))
    refuses(message, gltf.read, path)


def test_a_scale_below_zero_and_opacities_over_one_are_refused(tmp_path: Path) -> None:
    for accessor, message in ((2, "Gaussian 0 has the scales -0.5 .*1 of 101 "), (3, "has an opacity of -0.5")):
        path = tmp_path / "model.gltf"
        gltf.write(path, lopsided(101, degree=0))
        view = document(path)["bufferViews"][accessor]
        with (tmp_path / "model.bin").open("r+b") as file:
            file.seek(view["byteOffset"])
            file.write(struct.pack("<f", -0.5))
        refuses(message, gltf.read, path)


def test_nothing_is_written_where_it_cannot_be(tmp_path: Path) -> None:
    model = lopsided(5)
    none = Gaussians(
        *(getattr(model, name)[:0] for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh"))
    )
    refuses("no Gaussians", gltf.write, tmp_path / "model.glb", none)
    model.means[2] = np.inf
    refuses("Gaussian 2 has a position that is not finite", gltf.write, tmp_path / "model.glb", model)
    assert not list(tmp_path.iterdir())
