# SPDX-License-Identifier: Apache-2.0
"""A short form of `tools/stress/run survey`, and that its surveys are what they claim to be."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import stress_survey
from calls import Capture, printed
from survey import Survey, write_binary, write_text

SMALL = ["--images", "12", "--points", "120", "--observations", "480", "--frames", "5"]


@pytest.mark.slow
def test_surveys_of_each_kind(tmp_path: Path, capsys: Capture) -> None:
    """Also that nothing is left of them."""
    folder = tmp_path / "survey"
    found = json.loads(printed(capsys, [*SMALL, "--folder", folder, "--json"], call=stress_survey.main).out)
    assert {kind: (rows["images"], rows["points"]) for kind, rows in found.items()} == {
        "binary": (12, 120),
        "text": (12, 120),
        "transforms": (5, 0),
    }
    assert found["binary"]["digest"] == found["text"]["digest"]
    assert found["binary"]["length_unit"] == found["text"]["length_unit"]
    assert not any(rows["warnings"] for rows in found.values())
    assert all(rows[step]["peak_mib"] > 0 for rows in found.values() for step in ("load", "unit"))
    assert not folder.exists()


@pytest.mark.parametrize("views", [1, 4, 5])
@pytest.mark.parametrize("kind", ["binary", "text"])
def test_pycolmap_reads_the_survey_and_its_points_are_where_they_are_observed(
    kind: str, views: int, tmp_path: Path
) -> None:
    survey = Survey(images=12, own=10, views=views)  # rows of six cameras, so that tracks end at them
    (write_binary if kind == "binary" else write_text)(survey, tmp_path)
    model = pycolmap.Reconstruction(tmp_path)
    assert (model.num_images(), model.num_points3D()) == (12, 120)
    off = []
    for image in model.images.values():
        for place, observed in enumerate(image.points2D):
            point = model.points3D[observed.point3D_id]
            assert (image.image_id, place) in {(one.image_id, one.point2D_idx) for one in point.track.elements}
            off.append(image.project_point(point.xyz) - observed.xy)
    assert len(off) == sum(point.track.length() for point in model.points3D.values()) > 0
    assert np.abs(off).max() < 1e-3  # pixels of up to 6000 are stored as float32


def test_wrong_calls(tmp_path: Path, capsys: Capture) -> None:
    for flags, told in (
        (["--kinds", "binary,XML"], "--kinds binary,XML: expected some of binary, text, transforms"),
        (["--folder", str(tmp_path)], "exists, expected none"),
    ):
        assert stress_survey.main([*SMALL, *flags]) == 2
        assert told in capsys.readouterr().err
