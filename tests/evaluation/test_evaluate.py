# SPDX-License-Identifier: Apache-2.0
"""Held-out evaluation: the contract of eval.json, alpha, and the pictures it leaves."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from clsplat.errors import ClsplatError, InputError
from clsplat.evaluation import metrics
from clsplat.evaluation.held_out import EvaluatedModel, evaluate, picture_names
from clsplat.images.alpha import background_colour, composite


@dataclass(frozen=True)
class Photo:
    name: str
    pixels: np.ndarray

    def load(self) -> np.ndarray:
        return self.pixels

    load_masked = load


def photos() -> list[Photo]:
    rng = np.random.default_rng(0)
    return [Photo(name, rng.random((16, 24, 3)).astype(np.float32)) for name in ("b/0.jpg", "a.png", "c.JPG")]


def half(photo: Photo) -> np.ndarray:
    return photo.load()[:, :, :3] * np.float32(0.5)


def test_result_is_the_contract() -> None:
    views = photos()
    result = evaluate(half, views, (0, 0, 0), model=EvaluatedModel(7, 100, 1.5))
    assert (result["step"], result["gaussians"], result["seconds"]) == (7, 100, 1.5)
    assert [view["name"] for view in result["views"]] == ["b/0.jpg", "a.png", "c.JPG"]
    for view, record in zip(views, result["views"], strict=True):
        assert record["psnr"] == metrics.psnr(half(view), view.pixels)
        assert record["ssim"] == metrics.ssim(half(view), view.pixels)
    for key in ("psnr", "ssim"):
        assert result["mean"][key] == pytest.approx(np.mean([record[key] for record in result["views"]]))
    assert json.loads(json.dumps(result, allow_nan=False)) == result


def test_a_perfect_render_is_valid_json() -> None:
    result = evaluate(Photo.load, photos(), (0, 0, 0), model=EvaluatedModel(None, 1, None))
    assert json.loads(json.dumps(result, allow_nan=False))["mean"]["psnr"] == 120


def test_no_views() -> None:
    assert evaluate(half, [], (0, 0, 0), model=EvaluatedModel(1, 1, 0.0))["mean"] == {}


def test_straight_alpha_over_the_background() -> None:
    image = np.array([[[1.0, 0.5, 0.0, 0.25], [0.2, 0.2, 0.2, 1.0], [9.0, 9.0, 9.0, 0.0]]], np.float32)
    expected = np.array([[[1.0, 0.875, 0.75], [0.2, 0.2, 0.2], [1.0, 1.0, 1.0]]])
    np.testing.assert_allclose(composite(image, background_colour("white")), expected, atol=1e-7)
    byte = np.uint8([[[255, 0, 51, 255], [255, 255, 255, 0]]])
    np.testing.assert_allclose(composite(byte, (0, 0, 0)), [[[1, 0, 0.2], [0, 0, 0]]], atol=1e-7)
    assert background_colour("random") == background_colour("black") == (0, 0, 0)


def test_alpha_views_are_measured_over_the_same_background() -> None:
    rng = np.random.default_rng(0)
    view = Photo("a.png", rng.random((16, 16, 4)).astype(np.float32))
    over_white = composite(view.pixels, (1, 1, 1))
    result = evaluate(lambda _: over_white, [view], (1, 1, 1), model=EvaluatedModel(1, 1, 0.0))
    assert result["mean"]["psnr"] == 120


def test_trouble_names_the_view() -> None:
    with pytest.raises(InputError, match=r"small\.png: .*too small for SSIM"):
        evaluate(half, [Photo("small.png", np.zeros((8, 8, 3)))], (0, 0, 0), model=EvaluatedModel(1, 1, 0.0))
    nothing = np.full((16, 16, 3), np.nan)
    with pytest.raises(ClsplatError, match=r"render of a\.png has values that are not finite"):
        evaluate(lambda _: nothing, [Photo("a.png", nothing)], (0, 0, 0), model=EvaluatedModel(1, 1, 0.0))


def test_picture_names() -> None:
    assert picture_names(["b/0.jpg", "a.x.png", "c"]) == ["b/0.png", "a.x.png", "c.png"]
    assert picture_names(["a.jpg", "a.png", "b.jpg"]) == ["a.jpg.png", "a.png.png", "b.png"]


def test_renders_in_other_spaces_are_left_as_srgb(tmp_path: Path) -> None:
    from skimage.io import imread

    views = photos()[1:2]
    linear = evaluate(half, views, (0, 0, 0), tmp_path, model=EvaluatedModel(1, 1, 0.0), space="lin_rec709")
    assert linear == evaluate(half, views, (0, 0, 0), model=EvaluatedModel(1, 1, 0.0)), "they are measured as they are"
    values = half(views[0]).astype(np.float64)
    curve = np.where(values > 0.0031308, 1.055 * values ** (1 / 2.4) - 0.055, 12.92 * values)  # IEC 61966-2-1
    np.testing.assert_allclose(imread(tmp_path / "a.png") / 255, curve, atol=0.5 / 255 + 1e-6)
    with pytest.raises(InputError, match="the model's colour space nowhere: is not in the configuration"):
        evaluate(half, views, (0, 0, 0), tmp_path, model=EvaluatedModel(1, 1, 0.0), space="nowhere")


def test_renders_are_left_as_pictures(tmp_path: Path) -> None:
    from skimage.io import imread

    views = photos()
    evaluate(half, views, (0, 0, 0), tmp_path / "test", model=EvaluatedModel(1, 1, 0.0))
    files = sorted(str(path.relative_to(tmp_path / "test")) for path in (tmp_path / "test").rglob("*.*"))
    assert files == ["a.png", "b/0.png", "c.png"]
    picture = imread(tmp_path / "test" / "b" / "0.png")
    np.testing.assert_allclose(picture / 255, half(views[0]), atol=0.5 / 255 + 1e-6)


def test_pixels_that_a_mask_leaves_out_are_not_measured() -> None:
    rng = np.random.default_rng(1)
    truth = np.concatenate([rng.random((30, 40, 3)), np.ones((30, 40, 2))], axis=2).astype(np.float32)
    truth[8:20, 5:30] = 0
    render = np.clip(truth[:, :, :3] + 0.1, 0, 1)
    scores = []
    for fill in (0.0, 0.7):
        image = np.where(truth[:, :, 4:] > 0, render, fill).astype(np.float32)
        view = Photo("a.png", truth)
        scores.append(evaluate(lambda _view, i=image: i, [view], (0, 0, 0), model=EvaluatedModel(1, 1, 0.0))["views"])
    assert scores[0] == scores[1]
    assert scores[0][0]["counted"] == 0.75
    kept = truth[:, :, 4] > 0
    assert scores[0][0]["psnr"] == pytest.approx(-10 * np.log10(np.mean((render - truth[:, :, :3])[kept] ** 2)))


def test_a_mask_that_leaves_nothing_is_named() -> None:
    view = Photo("a.png", np.zeros((30, 40, 5), np.float32))
    with pytest.raises(InputError, match=r"a\.png: its mask excludes all pixels"):
        evaluate(lambda v: v.pixels[:, :, :3], [view], (0, 0, 0), model=EvaluatedModel(1, 1, 0.0))
