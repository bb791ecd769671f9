# SPDX-License-Identifier: Apache-2.0
"""Arguments of `clsplat.torch.rasterization`: gsplat's names and defaults; those that are refused, by name."""

from __future__ import annotations

import inspect
from typing import Any

import pytest
from calls import no_warnings, refuses
from needs import require

require("torch")

import clouds
import torch
from clouds import given

import clsplat.torch
from clsplat.torch import arguments, rasterization

pytestmark = pytest.mark.needs("torch")


def spoiled(name: str, place: tuple[int, ...]) -> torch.Tensor:
    value: torch.Tensor = given()[name]
    value[place] = torch.nan
    return value


HOMES = {
    "gsplat.rendering": ("rasterization",),
    "gsplat.cuda._wrapper": (
        *("spherical_harmonics", "fully_fused_projection", "isect_tiles", "isect_offset_encode"),
        *("rasterize_to_pixels", "quat_scale_to_covar_preci"),
    ),
    "gsplat.relocation": ("compute_relocation",),
    "gsplat.optimizers": ("SelectiveAdam",),
}


@pytest.mark.needs("gsplat")
@pytest.mark.parametrize(("home", "ours"), [(home, name) for home, names in HOMES.items() for name in names])
def test_the_call_is_gsplats(home: str, ours: str) -> None:
    module = pytest.importorskip(home)
    expected = inspect.signature(getattr(module, ours)).parameters.values()
    found = inspect.signature(getattr(clsplat.torch, ours)).parameters.values()
    shared = [each for each in found if each.kind != inspect.Parameter.KEYWORD_ONLY]
    assert [each.name for each in shared] == [each.name for each in expected]

    def plain(default: Any) -> Any:
        return getattr(default, "name", default)

    assert [plain(each.default) for each in shared] == [plain(each.default) for each in expected]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        # features that clsplat does not have
        ({"with_ut": True}, "with_ut is True, expected False"),
        ({"with_eval3d": True}, "with_eval3d is True"),
        ({"distributed": True}, "distributed is True"),
        ({"camera_model": "ftheta"}, "camera_model is 'ftheta', expected one of pinhole"),
        ({"radial_coeffs": torch.zeros(1, 6)}, "radial_coeffs is given, expected None"),
        ({"tangential_coeffs": torch.zeros(1, 2)}, "tangential_coeffs is given"),
        ({"thin_prism_coeffs": torch.zeros(1, 4)}, "thin_prism_coeffs is given"),
        ({"ftheta_coeffs": object()}, "ftheta_coeffs is given"),
        ({"rolling_shutter": clsplat.torch.RollingShutterType.ROLLING_LEFT_TO_RIGHT}, "rolling_shutter is .*LEFT"),
        ({"viewmats_rs": torch.eye(4)[None]}, "viewmats_rs is given"),
        (
            {"render_mode": "d"},
            "render_mode is 'd', expected one of RGB, D, ED, .*with_eval3d, which clsplat.torch lacks",
        ),
        ({"render_mode": "Ed"}, "render_mode is 'Ed', expected one of .*with_eval3d, which clsplat.torch lacks"),
        ({"render_mode": "RGB-d"}, "render_mode is 'RGB-d', expected one of .*with_eval3d, which clsplat.torch lacks"),
        (
            {"render_mode": "RGB-Ed"},
            "render_mode is 'RGB-Ed', expected one of .*with_eval3d, which clsplat.torch lacks",
        ),
        ({"global_z_order": False}, "global_z_order is False, expected True: .* with_ut, which clsplat.torch lacks"),
        ({"return_normals": True}, "return_normals is True, expected False"),
        ({"rays": torch.zeros(1, 1, 29, 37, 6)}, "rays is given, expected None"),
        ({"lidar_coeffs": object()}, "lidar_coeffs is given"),
        ({"external_distortion_coeffs": object()}, "external_distortion_coeffs is given"),
        ({"extra_signals": torch.zeros(8, 2)}, "extra_signals is given"),
        ({"extra_signals_sh_degree": 3}, "extra_signals_sh_degree is given"),
        ({"renderer_config": object()}, "renderer_config is a object, expected None"),
        # what is no such argument
        ({"means": torch.zeros(8, 2)}, r"means is float32 \(8, 2\), expected a tensor \(N, 3\)"),
        ({"means": [[0.0, 0, 3]] * 8}, "means is a list, expected a tensor"),
        ({"quats": torch.zeros(7, 4)}, r"quats is float32 \(7, 4\), expected a tensor \(8, 4\)"),
        ({"quats": None}, "quats is a NoneType"),
        ({"scales": torch.zeros(8)}, r"scales is float32 \(8,\)"),
        ({"opacities": torch.zeros(8, 1)}, r"opacities is float32 \(8, 1\), expected a tensor \(8,\)"),
        ({"opacities": torch.zeros(8).int()}, r"opacities is int32 \(8,\), expected a dense tensor of float32"),
        ({"colors": torch.zeros(8)}, r"colors is float32 \(8,\), expected a tensor \(8, D\) or \(1, 8, D\)"),
        ({"colors": torch.zeros(8, 0)}, "colors is a tensor without channels, expected at least 1"),
        ({"colors": None}, r"colors is a NoneType, expected a tensor \(8, D\) or \(1, 8, D\)"),
        ({"colors": None, "render_mode": "RGB+D"}, "colors is a NoneType"),
        ({"sh_degree": 1}, r"colors is float32 \(8, 3\), expected a tensor \(8, K, 3\)"),
        (
            {"sh_degree": 1, "colors": torch.zeros(8, 1, 3)},
            "colors is a tensor of 1 SH coefficients, expected at least 4",
        ),
        (
            {"sh_degree": 5, "colors": torch.zeros(8, 36, 3)},
            "sh_degree is 5, expected a whole number from 0 to 4, or None",
        ),
        ({"viewmats": torch.eye(4)}, r"viewmats is float32 \(4, 4\), expected a tensor \(C, 4, 4\)"),
        ({"viewmats": torch.zeros(0, 4, 4)}, "viewmats is of shape .* at least one camera"),
        ({"Ks": torch.zeros(2, 3, 3)}, r"Ks is float32 \(2, 3, 3\), expected a tensor \(1, 3, 3\)"),
        ({"backgrounds": torch.zeros(3)}, r"backgrounds is float32 \(3,\), expected a tensor \(1, 3\)"),
        ({"covars": torch.zeros(8, 6)}, r"covars is float32 \(8, 6\), expected a tensor \(8, 3, 3\)"),
        ({"width": 0}, "width is 0, expected a whole number of pixels"),
        ({"height": 2.5}, r"height is 2\.5"),
        ({"height": torch.tensor(2.5)}, r"height is tensor\(2\.5000\), expected a whole number of pixels"),
        ({"width": torch.tensor([37, 29])}, r"width is tensor\(\[37, 29\]\), expected a whole number"),
        ({"width": torch.tensor(True)}, r"width is tensor\(True\), expected a whole number"),
        ({"width": float("inf")}, "width is inf, expected a whole number"),
        ({"eps2d": torch.tensor([0.3, 0.3])}, r"eps2d is tensor\(\[0\.3000, 0\.3000\]\), expected a number"),
        ({"sh_degree": 1.5, "colors": torch.zeros(8, 4, 3)}, r"sh_degree is 1\.5, expected a whole number from 0 to 4"),
        ({"tile_size": 0}, "tile_size is 0"),
        ({"near_plane": "1"}, "near_plane is '1', expected a number"),
        ({"far_plane": float("nan")}, "far_plane is nan"),
        ({"eps2d": -1}, "eps2d is -1, expected a number of at least 0"),
        ({"radius_clip": -1}, "radius_clip is -1"),
        ({"alpha_max": 1.5}, r"alpha_max is 1\.5"),
        ({"render_mode": "depth"}, "render_mode is 'depth', expected one of RGB, D, ED"),
        ({"rasterize_mode": "soft"}, "rasterize_mode is 'soft', expected one of classic, antialiased"),
        ({"sparse_grad": True, "packed": False}, "sparse_grad is True, expected False"),
    ],
)
def test_arguments_that_are_none(changes: dict[str, Any], message: str) -> None:
    refuses(message, rasterization, **given(**changes))


@pytest.mark.parametrize(
    ("name", "place"),
    [
        *(("means", (3, 1)), ("quats", (0, 0)), ("scales", (7, 2)), ("opacities", (4,)), ("colors", (2, 0))),
        *(("viewmats", (0, 3, 3)), ("Ks", (0, 0, 1))),
    ],
)
def test_nan_is_refused_by_name_and_place(name: str, place: tuple[int, ...]) -> None:
    where = ", ".join(map(str, place))
    changed = given(**{name: spoiled(name, place)})
    refuses(rf"^{name}: \[{where}\] is nan, expected finite numbers", rasterization, **changed)


def test_nan_in_backgrounds_that_depths_do_not_have() -> None:
    changed = given(backgrounds=torch.full((1, 3), torch.nan), render_mode="D")
    refuses(r"^backgrounds has 3 NaN", rasterization, **changed)


def test_other_kinds_of_numbers_come_back_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arguments, "_CONVERSIONS_REPORTED", set())
    float64 = clouds.cloud(8)
    float64["means"].requires_grad_()
    with pytest.warns(UserWarning, match="tensors of float64 on cpu are copied to float32 on the CPU"):
        images, alphas, meta = rasterization(**float64)
    assert images.dtype == alphas.dtype == meta["means2d"].dtype == torch.float64
    with no_warnings():
        images, _, _ = rasterization(**float64)
        images.sum().backward()
    assert float64["means"].grad.dtype == torch.float64


def test_float32_is_shared(monkeypatch: pytest.MonkeyPatch) -> None:
    means = given()["means"]
    assert arguments.as_array(means).ctypes.data == means.data_ptr()
    array = arguments.as_array(means)
    assert arguments.as_tensor(array, means).data_ptr() == array.ctypes.data


def test_tensors_that_are_views_give_what_their_copies_give() -> None:
    made = given()
    turned = {**made, "means": made["means"].T.contiguous().T, "colors": made["colors"].flip(1).flip(1)}
    turned["viewmats"] = made["viewmats"].mT.contiguous().mT
    assert torch.equal(rasterization(**turned)[0], rasterization(**made)[0])


def test_the_largest_alpha() -> None:
    """0.999 is gsplat's; a Gaussian over a pixel that is opaque enough shows it."""
    made = given(
        means=torch.tensor([[0.0, 0, 3]]), quats=torch.tensor([[1.0, 0, 0, 0]]), scales=torch.full((1, 3), 50.0),
        opacities=torch.ones(1), colors=torch.ones(1, 3),
    )  # fmt: skip
    assert rasterization(**made)[1].max().item() == pytest.approx(0.999, abs=1e-6)
    assert rasterization(**made, alpha_max=0.99)[1].max().item() == pytest.approx(0.99, abs=1e-6)


def test_the_device_is_named() -> None:
    refuses("no such thing", rasterization, **given(), device="no such thing", error=Exception)
