# SPDX-License-Identifier: Apache-2.0
"""The words by which programs say that a model is antialiased, in comments of PLYs and in SOG's meta.json."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import pytest
from calls import no_warnings
from models import random_gaussians

from clsplat.gaussians import Gaussians
from clsplat.models import formats
from clsplat.models.codec.antialias import of_comments, of_line, of_object
from clsplat.models.info import model_info

YES = [
    *("antialiased 1", "Antialiased: TRUE", "anti-aliased=yes", "anti_aliasing on", "ANTIALIAS  1", "anti aliased 1"),
    *("SplatRenderMode: mip", "SplatRenderMode: mip-0.1", "splatrendermode=MIP", "SplatRenderMode: mip splatting"),
    *("rasterize_mode antialiased", "rasterize-mode: antialiased", "--pipeline.model.rasterize-mode antialiased"),
    *('"rasterize_mode": "antialiased",', "mip_splatting true", "use_mip: 1", "mip-filter: 1"),
    *("antialiased 1.0", "antialias: enabled", "anti-aliased: y", "Mip Splatting = 1", "mip splatting: true", "aa 1"),
    *("anti aliasing: on", "SplatRenderMode: Mip 0.1", "SplatRenderMode: mip_2", "train_flags antialiasing"),
    *("antialiased", "--antialiasing", "Anti-Aliased", "python train.py -s garden --antialiasing --eval"),
    *("model: mip", "model: antialiased", "render_mode: mip-splatting", "train_flags: --antialiasing"),
]
NO = [
    *("antialiased 0", "AntiAliased: False", "anti-aliasing = off", "antialias no", "SplatRenderMode: default"),
    *("SplatRenderMode: 2dgs", "rasterize_mode classic", "rasterize_mode: Classic", "mip-splatting 0"),
    *("antialiased: 0.0", "anti aliased: disabled", "aa: n"),
]
NOTHING = [
    *("not trained antialiased by X", "antialiased 2", "this model is antialiased", "antialiased maybe"),
    *("is it antialiased: no", "Exported by mip viewer 1", "rasterize_mode", "rasterize_mode fast", "", "mip"),
    *("model: mipnerf360_garden", "model mip-nerf360", "render_mode: mipmapped", "SplatRenderMode: mipmapped"),
    *("model: mip-0.1", "mip: 360", "scene: mip", "not with --antialiasing", "render with --antialiasing for less"),
    *("antialiased 1 of 3", "generator mip", "near 1", "SplatRenderMode: mip or default"),
]


@pytest.mark.brings(
    "Postshot, Brush, splat-transform", "`antialiased 1`, `SplatRenderMode: mip` in a header", "antialiased or not"
)
@pytest.mark.parametrize(
    ("line", "meaning"),
    [*((line, True) for line in YES), *((line, False) for line in NO),
     *((line, None) for line in NOTHING)],
)  # fmt: skip
def test_a_line(line: str, meaning: bool | None) -> None:
    assert of_line(line) is meaning


def test_the_last_counts_and_a_contradiction_is_told() -> None:
    said = of_comments(["antialiased 1", "by hand", "SplatRenderMode: default"])
    assert not said.antialiased
    assert "'antialiased 1' and 'SplatRenderMode: default', the last of which is used" in said.contradiction
    assert of_comments(["rasterize_mode classic", "antialiased 1"]).antialiased
    assert of_comments(["antialiased 1", "SplatRenderMode: mip"]).contradiction == ""
    assert not of_comments([]).antialiased


@pytest.mark.parametrize(
    ("lines", "named"),
    [
        (["this model is antialiased", "antialiased maybe"], "this model is antialiased"),
        (["by hand", "Anti-Aliasing: fast"], "Anti-Aliasing: fast"),
        (["antialiased?"], "antialiased?"),
        (["this model is antialiased", "antialiased 0"], ""),
        (["not trained antialiased by X", "without antialiasing", "model: mipnerf360"], ""),
        (["made with mip-splatting's viewer", "xantialiasedx 1"], ""),
    ],
)
def test_words_that_are_not_understood_are_told_once(lines: list[str], named: str) -> None:
    said = of_comments(lines)
    assert not said.antialiased
    told = f"says {named!r}, which is not understood: the model is read as not antialiased, expected words such as "
    assert said.warning == (f"{told}'antialiased 1'" if named else "")


@pytest.mark.brings("gsplat, nerfstudio", "`rasterize_mode antialiased`", "the same")
@pytest.mark.parametrize("name", ["model.ply", "model.compressed.ply"])
def test_comments_of_plys(tmp_path: Path, name: str) -> None:
    path, model = tmp_path / name, random_gaussians(20, 0)
    for lines, wanted in (
        (["anti-aliased: yes"], True),
        (["rasterize_mode antialiased"], True),
        (["Not trained antialiased by X", "AntiAliased 0"], False),
    ):
        formats.save(path, model, comments=lines)
        with no_warnings():
            assert model_info(path)["antialiased"] == wanted, lines
            read = Gaussians.load(path)
        assert read.antialiased == wanted
        formats.save(tmp_path / "again.spz", read)
        assert Gaussians.load(tmp_path / "again.spz").antialiased == wanted
    formats.save(path, model, comments=["antialiased 1", "SplatRenderMode: default"])
    with pytest.warns(UserWarning, match=f"{name}: says 'antialiased 1' and 'SplatRenderMode: default', the last"):
        assert not Gaussians.load(path).antialiased


@pytest.mark.brings("splat-transform", "SOG with `model` in place of `antialias`", "both, written too")
@pytest.mark.parametrize(
    ("keys", "wanted", "told"),
    [
        ({"antialias": True}, True, False),
        ({"model": "antialiased"}, True, False),
        ({"model": "default"}, False, False),
        ({"model": "2dgs", "antialias": False}, False, False),
        ({"antialias": 1, "model": "Antialiased"}, True, False),
        ({"antialias": "false"}, False, False),
        ({"model": "mipnerf360"}, False, False),
        ({"antialias": "maybe"}, False, True),
        ({"model": ["antialiased"], "antialias": None}, False, False),
        ({"antialias": True, "model": "default"}, False, True),
        ({"antialias": False, "model": "antialiased"}, True, True),
    ],
)
def test_keys_of_sog(tmp_path: Path, keys: dict[str, Any], wanted: bool, told: bool) -> None:
    path = tmp_path / "meta.json"
    formats.save(path, random_gaussians(20, 0))
    meta = json.loads(path.read_text())
    assert of_object(meta).antialiased is False
    path.write_text(json.dumps(meta | keys))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert Gaussians.load(path).antialiased == wanted
        assert formats.format_of(path).describe(path)["antialiased"] == wanted
    assert [str(each.message).startswith(f"{path}: meta.json says ") for each in caught] == [True] * (2 * told)


def test_sog_is_written_with_both_keys(tmp_path: Path) -> None:
    path, model = tmp_path / "meta.json", random_gaussians(20, 0)
    formats.save(path, model)
    assert not {"antialias", "model"} & json.loads(path.read_text()).keys()
    model.antialiased = True
    formats.save(path, model)
    meta = json.loads(path.read_text())
    assert (meta["antialias"], meta["model"]) == (True, "antialiased")
