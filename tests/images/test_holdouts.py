# SPDX-License-Identifier: Apache-2.0
"""Holdouts read from depth EXR and deep EXR, and what is wrong with files that are none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from calls import refuses
from cg import write_flat, write_samples

from clsplat.images.holdouts import Surfaces, check_holdout, read_holdout, surfaces_of

DEPTH = np.array([[2.0, 0.0, np.inf], [3.0, 1e10, 5.0]])
SIZE = (3, 2)


def test_a_depth_exr(tmp_path: Path) -> None:
    found = read_holdout(write_flat(tmp_path / "z.exr", {"Z": DEPTH}), SIZE)
    assert found.surfaces.counts.tolist() == [[1, 0, 0], [1, 1, 1]] and (found.x, found.y) == (0, 0)
    np.testing.assert_array_equal(found.surfaces.rows[:, 0], np.float32([2, 3, 1e10, 5]))
    np.testing.assert_array_equal(found.surfaces.rows[:, 1:], [[z, 0, 0] for z in np.float32([2, 3, 1e10, 5])])


def test_alpha_of_the_same_layer_and_a_data_window(tmp_path: Path) -> None:
    alpha = np.array([[0.25, 0.5, 1], [0, 2, 1]])
    planes = {"A": np.zeros((2, 3)), "cg.A": alpha, "cg.Z": np.full((2, 3), 4.0)}
    path = write_flat(tmp_path / "z.exr", planes, size=(8, 6), window=(-1, 3, 3, 2))
    found = read_holdout(path, (8, 6), "cg.Z")
    assert (found.x, found.y) == (-1, 3) and found.surfaces.counts.tolist() == [[1, 1, 1], [0, 1, 1]]
    np.testing.assert_array_equal(found.surfaces.rows[:, 2], [0.75, 0.5, 0, 0, 0])


def test_a_channel_of_another_part(tmp_path: Path) -> None:
    specs = [oiio.ImageSpec(3, 2, 1, oiio.FLOAT) for _ in range(2)]
    for spec, name in zip(specs, ("A", "Z"), strict=True):
        spec.channelnames = (name,)
        spec.attribute("oiio:subimagename", f"part{name}")
    output = oiio.ImageOutput.create(str(tmp_path / "z.exr"))
    assert output.open(str(tmp_path / "z.exr"), specs)
    assert output.write_image(np.zeros((2, 3, 1), np.float32))
    assert output.open(str(tmp_path / "z.exr"), specs[1], "AppendSubimage")
    assert output.write_image(DEPTH.astype(np.float32)[:, :, None])
    output.close()
    assert read_holdout(tmp_path / "z.exr", SIZE).surfaces.counts.sum() == 4


def test_a_deep_exr(tmp_path: Path) -> None:
    """Samples in no order; one with a length, an opaque one whose length is not seen, one without alpha."""
    samples = [[[0.5, 6, 6], [0.75, 2, 4]], [], [[1, 3, 9]], [[0, 1, 1]], [], [[0.5, 2, 1]]]
    path = write_samples(tmp_path / "d.exr", SIZE, samples, ("A", "Z", "ZBack"))
    found = read_holdout(path, SIZE).surfaces
    assert found.counts.tolist() == [[2, 0, 1], [0, 0, 1]]
    wanted = [[2, 4, 0.25, -1], [6, 6, 0.5, 0], [3, 3, 0, 0], [2, 2, 0.5, 0]]
    np.testing.assert_allclose(found.rows, wanted, atol=1e-6)
    flat = read_holdout(write_samples(tmp_path / "e.exr", SIZE, [[[0.5, 6]]] + [[]] * 5), SIZE).surfaces
    np.testing.assert_array_equal(flat.rows, [[6, 6, 0.5, 0]])


def test_taken_and_scaled() -> None:
    begin = np.array([[[1.0, 2.0], [np.inf, 3.0]], [[4.0, 0.0], [5.0, 6.0]]])
    whole = surfaces_of(begin, begin, np.ones(begin.shape))
    assert whole.counts.tolist() == [[2, 1], [1, 2]] and whole.dense == 2
    part = whole.taken(np.array([1, 1, -1, 0]), np.array([1, 2, 0]))
    assert part.counts.tolist() == [[2, 2, 0, 1], [0, 0, 0, 0], [1, 1, 0, 2]]
    assert part.rows[:, 0].tolist() == [5, 6, 5, 6, 4, 3, 3, 1, 2]
    none = Surfaces(np.zeros((2, 2), np.int64), np.zeros((0, 4), np.float32))
    assert none.dense == 0 and len(none.taken(np.arange(2), np.arange(2)).rows) == 0
    length = surfaces_of(np.full((1, 1, 1), 2.0), np.full((1, 1, 1), 3.0), np.full((1, 1, 1), 0.5))
    np.testing.assert_allclose(length.scaled(np.float32([[2.0]])).rows, [[4, 6, 0.5, -0.5]])


def test_what_is_wrong(tmp_path: Path) -> None:
    nan, negative = (np.where(DEPTH == 3, value, DEPTH) for value in (np.nan, -3.0))
    cases = [
        (tmp_path / "none.exr", "none.exr: no such holdout file, expected a depth or deep EXR for each"),
        (
            write_flat(tmp_path / "s.exr", {"Z": np.ones((4, 4))}),
            "s.exr: has a display window of 4x4 pixels, expected 3x2",
        ),
        (
            write_flat(tmp_path / "c.exr", {"Y": DEPTH}),
            "c.exr: has the channels Y, expected Z; give the channel of its depths",
        ),
        (write_samples(tmp_path / "a.exr", SIZE, [[[1.0]]] * 6, ("Z",)), "a.exr: is a deep EXR without A, expected"),
        (write_flat(tmp_path / "z.tif", {"Z": DEPTH}), "z.tif: is not an EXR file, expected a depth or deep EXR"),
    ]
    for path, message in cases:
        refuses(f"^{tmp_path}/{message}", check_holdout, path, SIZE)
    decoded = [
        (write_flat(tmp_path / "n.exr", {"Z": nan}), "n.exr: 1 values of Z are NaN, expected depths"),
        (write_flat(tmp_path / "g.exr", {"Z": negative}), "g.exr: 1 values of Z are negative, expected depths along"),
        (write_flat(tmp_path / "f.exr", {"Z": DEPTH, "A": nan}), "f.exr: 1 values of A are NaN, expected"),
    ]
    for path, message in decoded:
        check_holdout(path, SIZE)
        refuses(f"^{tmp_path}/{message}", read_holdout, path, SIZE)
    cut = write_samples(tmp_path / "cut.exr", SIZE, [[[1.0, 2.0]]] * 6)
    cut.write_bytes(cut.read_bytes()[:-8])
    refuses(r"cut\.exr: does not decode: ", read_holdout, cut, SIZE)
