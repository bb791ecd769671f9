# SPDX-License-Identifier: Apache-2.0
"""gsplat's `rasterization`: images of Gaussians, with their gradient.

Arguments of gsplat that clsplat does not support raise InputError: those in the calls of `_refuse_missing` and
`_refuse_settings`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum
from typing import Any, Literal

import torch
from torch import Tensor

from clsplat.device.context import Device
from clsplat.library.checks import whole
from clsplat.library.rasterize import RASTERIZE_FILTER_MODES, RASTERIZE_RENDER_MODES
from clsplat.stages.ewa import EWA_CAMERA_MODELS
from clsplat.torch.arguments import check_choice, check_number, check_size, refuse, renamed
from clsplat.torch.autograd import PROJECTED_SPLAT_NAMES, BatchResults, PixelsFunction, ProjectionFunction
from clsplat.torch.compile_guards import outside_graphs
from clsplat.torch.covariances import UPPER_TRIANGLE_INDICES, sparse_upper
from clsplat.torch.inputs import GivenTensors, RasterizationSettings
from clsplat.torch.lazy_info import Meta
from clsplat.torch.tiles import isect_offset_encode, isect_tiles

HIT_DISTANCE_RENDER_MODES = ("d", "Ed", "RGB-d", "RGB-Ed")
"""Render modes that gsplat 1.6 supports only with `with_eval3d`."""
GSPLAT_TILE_SIZE_PX = 16
"""Default of tile_size, as in gsplat."""
PACKED_ID_NAMES = ("batch_ids", "camera_ids", "gaussian_ids")
"""Names in `meta` of the arrays with each splat's batch, camera and Gaussian index."""


class RollingShutterType(Enum):
    """gsplat's shutter types. clsplat supports only GLOBAL."""

    ROLLING_TOP_TO_BOTTOM = 0
    ROLLING_LEFT_TO_RIGHT = 1
    ROLLING_BOTTOM_TO_TOP = 2
    ROLLING_RIGHT_TO_LEFT = 3
    GLOBAL = 4


@outside_graphs
def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,  # noqa: N803  # gsplat's name
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int | None = GSPLAT_TILE_SIZE_PX,
    backgrounds: Tensor | None = None,
    render_mode: Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"] = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    channel_chunk: int = 32,  # noqa: ARG001
    distributed: bool = False,
    camera_model: Literal["pinhole", "ortho", "fisheye", "ftheta"] = "pinhole",
    segmented: bool = False,  # noqa: ARG001
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = RollingShutterType.GLOBAL,
    viewmats_rs: Tensor | None = None,
    *,
    return_normals: bool = False,
    global_z_order: bool = True,
    rays: Tensor | None = None,
    lidar_coeffs: Any = None,
    external_distortion_coeffs: Any = None,
    ut_params: Any = None,  # noqa: ARG001  # has an effect only with with_ut
    extra_signals: Tensor | None = None,
    extra_signals_sh_degree: int | None = None,
    renderer_config: Any = None,
    alpha_max: float = 0.999,
    device: Device | str | None = None,
) -> tuple[Tensor, Tensor, Meta]:
    """Render N Gaussians to images of C cameras: gsplat 1.5.3's function, with gsplat 1.6's new keyword arguments.

    The leading sizes `...` are batches, and may be absent. Every tensor has a gradient, including `Ks`.

    Parameters
    ----------
    means : (..., N, 3) Tensor
        In units of the scene.
    quats : (..., N, 4) Tensor
        w, x, y, z, of any length over 0.
    scales : (..., N, 3) Tensor
        Standard deviations above 0, in units of the scene.
    opacities : (..., N) Tensor
        0 to 1.
    colors : (..., N, D) or (..., C, N, D) Tensor, or None
        Any D. With `sh_degree`, SH coefficients (..., N, K, 3) or (..., C, N, K, 3), with order and signs as in 3DGS
        files; K is at least (sh_degree + 1)^2. May be None if only depth is rendered.
    viewmats : (..., C, 4, 4) Tensor
        Camera from world; x right, y down, z forward.
    Ks : (..., C, 3, 3) Tensor
        Intrinsics in pixels; the first pixel's centre is at 0.5. Skew is ignored.
    width, height : int
        Pixels. All sizes and numbers may be tensors of one element. Sizes may also be floats such as 40.0.
    near_plane, far_plane : float
        In units of the scene. Gaussians whose depth is not strictly between these are not drawn.
    radius_clip : float
        Pixels. Splats whose radii are at most this are not drawn.
    eps2d : float
        Low-pass filter in px^2, which is added to the variances of each splat.
    sh_degree : int, optional
        SH degree to use, 0 to 4. None if colors are not SH coefficients.
    packed : bool
        Let `meta` list only the splats in view.
    tile_size : int or None
        Side of a tile in pixels, which affects only the tile lists in `meta`. None means 16.
    backgrounds : (..., C, D) Tensor, optional
        Black if None.
    render_mode : str
        "RGB", "D" (depth along z), "ED" (expected depth), "RGB+D" or "RGB+ED". The depth is the last channel.
    sparse_grad : bool
        Make the gradients of means, quats and scales (or covars) COO tensors of the rows in view. Requires `packed`,
        and no batches.
    absgrad : bool
        Let the backward pass set `meta["means2d"].absgrad` to the sums over pixels of absolute gradients.
    rasterize_mode : str
        "classic", or "antialiased": scale opacities to compensate for eps2d (Mip-Splatting, Yu et al. 2024).
    camera_model : str
        "pinhole", "ortho" or "fisheye" (equidistant).
    covars : (..., N, 3, 3) Tensor, optional
        Covariances that replace quats and scales, which may then be None.
    channel_chunk, segmented, ut_params
        Ignored; they change no result.
    alpha_max : float
        Maximum of a splat's alpha at a pixel, below 1. The default is gsplat's; `clsplat train` and `render` use 0.99.
    device : Device or str, optional
        An open OpenCL device, or a name as `clsplat devices` lists them. None means the default device
        (docs/drivers.md).
    distributed, with_ut, with_eval3d, return_normals, global_z_order
        Only gsplat's defaults are supported.
    radial_coeffs, tangential_coeffs, thin_prism_coeffs, ftheta_coeffs, viewmats_rs
        Only None is supported.
    rays, lidar_coeffs, external_distortion_coeffs, extra_signals, extra_signals_sh_degree
        Only None is supported.
    rolling_shutter : RollingShutterType
        Only GLOBAL is supported.
    renderer_config
        None or gsplat's `RendererConfig_MixedBatch`.

    Returns
    -------
    images : (..., C, height, width, X) Tensor
        X is D, 1 or D + 1, depending on the render mode.
    alphas : (..., C, height, width, 1) Tensor
        0 to 1.
    meta : dict
        gsplat's names: "batch_ids", "camera_ids", "gaussian_ids" (nnz,) int64, None unless packed. "radii" (..., C, N,
        2) or (nnz, 2) int32, in pixels, 0 if not in view. "means2d" (..., 2) in pixels. "depths". "conics" (..., 3):
        xx, xy, yy of the inverse covariance, 1 / px^2. "opacities", after compensation. "tiles_per_gauss", "isect_ids",
        "flatten_ids" and "isect_offsets" are computed on first access. Also "tile_width", "tile_height", "width",
        "height", "tile_size", "n_batches" and "n_cameras".

    Raises
    ------
    InputError
        If a shape is wrong, there is a NaN, a setting is out of range, or an argument is not supported (above); it
        names the argument. Also for gsplat 1.6's hit distance modes, the camera model ftheta, and tensors of
        torch.func.

    Notes
    -----
    Kerbl et al. 2023; gsplat 1.5.3, https://docs.gsplat.studio. If OpenCL runs on the CPU, float32 tensors on the CPU
    are not copied. Tensors of other types or devices are copied, and results are copied back, with a warning.
    """
    _refuse_missing(
        distributed=distributed,
        with_ut=with_ut,
        with_eval3d=with_eval3d,
        radial_coeffs=radial_coeffs,
        tangential_coeffs=tangential_coeffs,
        thin_prism_coeffs=thin_prism_coeffs,
        ftheta_coeffs=ftheta_coeffs,
        viewmats_rs=viewmats_rs,
        return_normals=return_normals,
        rays=rays,
        lidar_coeffs=lidar_coeffs,
        external_distortion_coeffs=external_distortion_coeffs,
        extra_signals=extra_signals,
        extra_signals_sh_degree=extra_signals_sh_degree,
    )
    _refuse_settings(global_z_order, renderer_config, render_mode, rolling_shutter)
    check_choice("camera_model", camera_model, EWA_CAMERA_MODELS)
    check_choice("render_mode", render_mode, RASTERIZE_RENDER_MODES)
    check_choice("rasterize_mode", rasterize_mode, RASTERIZE_FILTER_MODES)
    width, height = check_size("width", width), check_size("height", height)
    tile_size = GSPLAT_TILE_SIZE_PX if tile_size is None else check_size("tile_size", tile_size)
    depth_alone = render_mode in {"D", "ED"}
    if colors is None and depth_alone:
        sh_degree, backgrounds = None, None
        colors = torch.zeros(*opacities.shape, 1) if isinstance(opacities, Tensor) else colors
    given = GivenTensors(means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, covars)
    batch = given.check(sh_degree)
    if sparse_grad and (batch or not packed):
        raise refuse("sparse_grad", sparse_grad, "False with batches, and where packed is False")
    settings = RasterizationSettings(
        width=width,
        height=height,
        near_plane=check_number("near_plane", near_plane),
        far_plane=check_number("far_plane", far_plane),
        radius_clip=check_number("radius_clip", radius_clip, 0),
        eps2d=check_number("eps2d", eps2d, 0),
        alpha_max=check_number("alpha_max", alpha_max, 1 / 255, 1 - 1e-6),
        sh_degree=None if sh_degree is None else whole(sh_degree),
        render_mode=render_mode,
        rasterize_mode=rasterize_mode,
        camera_model=camera_model,
        absolute_gradients=absgrad,
        device=device,
    )
    given = given.used(depth_alone=depth_alone)
    differentiable = torch.is_grad_enabled() and given.require_grad
    with renamed(quaternions="quats", intrinsics="Ks"):
        results = given.rasterized(settings, batch, differentiable=differentiable)
    expected = render_mode.endswith("ED")
    call = BatchResults(results, batch, packed=packed, sparse=sparse_grad, absolute=absgrad, expected_depth=expected)
    # dual tensors go on to `_with_gradient`, where PyTorch raises its error for forward-mode differentiation
    if not differentiable and not given.have_tangents:
        return *call.pixels(means), _meta(call, means, None, width, height, tile_size)
    splats, images, alphas = _with_gradient(call, given, settings.sh_degree, depth_alone=depth_alone)
    return images, alphas, _meta(call, means, splats, width, height, tile_size)


def _with_gradient(
    call: BatchResults, given: GivenTensors, sh_degree: int | None, *, depth_alone: bool
) -> tuple[list[Tensor], Tensor, Tensor]:
    """The splats' means2d, conics, depths and opacities, the images and the alphas, as differentiable tensors.

    sh_degree: None if colors are not SH coefficients. depth_alone: True if no colour is rendered.
    """
    covars, colors = given.covars, given.colors
    if covars is not None:
        covars = (
            sparse_upper(covars) if call.sparse else covars[..., UPPER_TRIANGLE_INDICES[0], UPPER_TRIANGLE_INDICES[1]]
        )
    coefficients = None if sh_degree is None or depth_alone else colors
    shapes = (given.quats, given.scales, covars)
    *splats, colors2d = ProjectionFunction.apply(
        call, given.means, *shapes, given.opacities, coefficients, given.viewmats, given.Ks
    )
    values = None if depth_alone else colors if sh_degree is None else colors2d
    images, alphas = PixelsFunction.apply(call, *splats, values, given.backgrounds)
    return splats, images, alphas


def _refuse_settings(global_z_order: Any, renderer_config: Any, render_mode: str, rolling_shutter: Any) -> None:
    """Raise InputError for settings that gsplat supports only with `with_ut` or `with_eval3d`."""
    if global_z_order is not True:
        raise refuse(
            "global_z_order", global_z_order, "True: gsplat allows False only with with_ut, which clsplat.torch lacks"
        )
    if type(renderer_config).__name__ not in {"NoneType", "RendererConfig_MixedBatch"}:
        raise refuse("renderer_config", f"a {type(renderer_config).__name__}", "None: clsplat.torch lacks with_eval3d")
    if render_mode in HIT_DISTANCE_RENDER_MODES:
        raise refuse(
            "render_mode",
            repr(render_mode),
            f"one of {', '.join(RASTERIZE_RENDER_MODES)}: gsplat renders hit distances only with with_eval3d, which "
            "clsplat.torch lacks",
        )
    if getattr(rolling_shutter, "name", rolling_shutter) != "GLOBAL":
        raise refuse("rolling_shutter", rolling_shutter, "GLOBAL, the only shutter that clsplat.torch supports")


def _refuse_missing(**given: Any) -> None:
    """Raise InputError for an argument of gsplat that is not supported, unless it is None or False."""
    for name, value in given.items():
        if value is not None and value is not False:
            found = str(value) if isinstance(value, bool) else "given"
            wanted = "False" if isinstance(value, bool) else "None"
            raise refuse(name, found, f"{wanted}: clsplat.torch does not support it")


def _meta(
    call: BatchResults, like: Tensor, splats: Sequence[Tensor] | None, width: int, height: int, tile_size: int
) -> Meta:
    """The dictionary `meta` of `rasterization`, with gsplat's entries in gsplat's order.

    like: a tensor from which the entries take device and dtype.
    splats: means2d, conics, depths and opacities; None computes them on first access, without gradient.
    """
    batches, cameras, _ = call.sizes
    like = like.new_empty(0)  # empty, so that the dictionary does not keep the caller's tensor alive
    columns, rows = math.ceil(width / tile_size), math.ceil(height / tile_size)

    def ids() -> dict[str, Any]:
        return dict(zip(PACKED_ID_NAMES, call.ids(like.device), strict=True))

    def radii() -> dict[str, Any]:
        return {"radii": torch.from_numpy(call.radii()).to(like.device)}

    def all_splats() -> dict[str, Any]:
        return dict(zip(PROJECTED_SPLAT_NAMES, call.splats(like) if splats is None else splats, strict=True))

    # `tiles` must not refer to the dictionary: the cycle of references would keep memory until a garbage collection.
    def tiles() -> dict[str, Any]:
        batch_ids, camera_ids, gaussian_ids = (None, None, None) if call.in_view is None else call.ids(like.device)
        means2d, _, depths, _ = call.splats(like)
        per_gauss, isect_ids, flatten_ids = isect_tiles(
            means2d,
            radii()["radii"],
            depths,
            tile_size,
            columns,
            rows,
            packed=call.packed,
            n_images=batches * cameras,
            image_ids=None if batch_ids is None or camera_ids is None else batch_ids * cameras + camera_ids,
            gaussian_ids=gaussian_ids,
        )
        offsets = isect_offset_encode(isect_ids, batches * cameras, columns, rows)
        return {
            "tiles_per_gauss": per_gauss,
            "isect_ids": isect_ids,
            "flatten_ids": flatten_ids,
            "isect_offsets": offsets.reshape(*call.batch, cameras, rows, columns),
        }

    meta = Meta(dict.fromkeys(PACKED_ID_NAMES))
    if call.packed:
        meta.later(PACKED_ID_NAMES, ids)
    meta.later(("radii",), radii)
    meta.later(("means2d", "depths", "conics", "opacities"), all_splats)
    meta.update({"tile_width": columns, "tile_height": rows})
    meta.later(("tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets"), tiles)
    meta.update({"width": width, "height": height, "tile_size": tile_size, "n_batches": batches, "n_cameras": cameras})
    return meta
