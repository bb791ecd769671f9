# SPDX-License-Identifier: Apache-2.0
"""`rasterization`: images of Gaussians, by gsplat's call, with their gradient."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum
from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd import forward_ad

from clsplat.device.context import Device
from clsplat.library.checks import degree, whole
from clsplat.library.rasterize import rasterize
from clsplat.stages.harmonics import HIGHEST
from clsplat.torch.arguments import check, check_choice, check_number, check_shape, check_size, refuse, renamed
from clsplat.torch.autograd import SPLATS, Batches, Call, Pixels, Projection
from clsplat.torch.covariances import UPPER, sparse_upper
from clsplat.torch.graphs import outside_graphs
from clsplat.torch.meta import Meta
from clsplat.torch.tiles import isect_offset_encode, isect_tiles

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
HIT_DISTANCES = ("d", "Ed", "RGB-d", "RGB-Ed")
"""Modes of gsplat 1.6, which has them with `with_eval3d` alone."""
RASTERIZE_MODES = ("classic", "antialiased")
CAMERA_MODELS = ("pinhole", "ortho", "fisheye")
TILE_SIZE = 16
IDS = ("batch_ids", "camera_ids", "gaussian_ids")
"""Names of a splat's own in `meta`."""


class RollingShutterType(Enum):
    """gsplat's names of shutters. clsplat has the last."""

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
    tile_size: int | None = TILE_SIZE,
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
    ut_params: Any = None,  # noqa: ARG001  # of with_ut
    extra_signals: Tensor | None = None,
    extra_signals_sh_degree: int | None = None,
    renderer_config: Any = None,
    alpha_max: float = 0.999,
    device: Device | str | None = None,
) -> tuple[Tensor, Tensor, Meta]:
    """Images, alphas and `meta` of N Gaussians in C cameras: gsplat 1.5.3's function, argument by argument, and those
    of gsplat 1.6 by name.

    Leading sizes `...` are those of batches, and may be none. Tensors of float32 on the CPU share their memory with a
    CPU's OpenCL device; others are copied there and back, which a warning says once. Everything has a gradient, `Ks`
    too.

    means: (..., N, 3), in units of the scene. quats: (..., N, 4), w x y z, of any length. scales: (..., N, 3), standard
    deviations, over 0. opacities: (..., N), in [0, 1]. colors: (..., N, D) or (..., C, N, D) with any D; with
    `sh_degree` coefficients (..., N, K, 3) or (..., C, N, K, 3), K >= (sh_degree + 1)^2, in the order and with the
    signs of 3DGS files; None where depth alone is drawn. viewmats: (..., C, 4, 4), camera from world, x right, y down,
    z forward. Ks: (..., C, 3, 3), in pixels, the centre of the first pixel at 0.5; skew is ignored. width, height:
    pixels. near_plane, far_plane: depths between which a Gaussian is drawn. radius_clip: pixels; a splat of no larger
    radius is not drawn. eps2d: pixels^2, added to the variance of each splat. sh_degree: the degree to use, 0 to 4;
    None for colours. packed: `meta` has the splats in view alone. tile_size: pixels, of the tile lists in `meta` alone;
    None for 16. backgrounds: (..., C, D). render_mode: colour, depth along z (D), expected depth (ED), or colour and
    depth, in the last channel. sparse_grad: with `packed`, without batches: the gradients of means, quats and scales
    (or covars) are COO tensors of the rows in view. absgrad: after the backward pass `meta["means2d"].absgrad` has sums
    over pixels of absolute gradients. rasterize_mode: "antialiased" scales opacities by what eps2d added
    (Mip-Splatting). camera_model: pinhole, ortho or fisheye (equidistant). covars: (..., N, 3, 3) in the place of quats
    and scales, which may be None. alpha_max: the largest alpha, under 1; gsplat's 0.999, where `clsplat train` and
    `render` have 0.99. device: an OpenCL device, open or as `clsplat devices` lists it; None for the first.
    channel_chunk, segmented and ut_params change no result, and are ignored. Sizes and numbers may be tensors of one
    number; sizes may be 40.0.

    Returns images (..., C, height, width, X), X = D, 1 or D + 1 by the mode, alphas (..., C, height, width, 1), and
    meta, a dictionary with gsplat's names: batch_ids, camera_ids, gaussian_ids (nnz,) int64, None unless packed; radii
    (..., C, N, 2) or (nnz, 2) int32, pixels, 0 where not in view; means2d (.., 2), pixels; depths; conics (.., 3), the
    inverse covariance's xx, xy, yy, 1 / pixels^2; opacities, with the compensation; tiles_per_gauss, isect_ids,
    flatten_ids, isect_offsets, made when they are first looked at; tile_width, tile_height, width, height, tile_size,
    n_batches, n_cameras.

    Raises InputError, which names the argument: other shapes, NaN, settings out of range; and `distributed`, `with_ut`,
    `with_eval3d`, what gsplat 1.6 has with these two alone (modes of hit distances, return_normals, another
    global_z_order), the model ftheta, coefficients of lenses, shutters other than GLOBAL, rays, extra_signals, and
    tensors of torch.func, which clsplat does not have.

    Source: gsplat 1.5.3, https://docs.gsplat.studio; Kerbl et al. 2023.
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
    if global_z_order is not True:
        raise refuse(
            "global_z_order", global_z_order, "True: clsplat.torch has no with_ut, which gsplat has False with"
        )
    if type(renderer_config).__name__ not in {"NoneType", "RendererConfig_MixedBatch"}:
        raise refuse("renderer_config", f"a {type(renderer_config).__name__}", "None: clsplat.torch has no with_eval3d")
    if render_mode in HIT_DISTANCES:
        raise refuse(
            "render_mode",
            repr(render_mode),
            f"one of {', '.join(RENDER_MODES)}: clsplat.torch has no with_eval3d, which gsplat has hit distances with",
        )
    if getattr(rolling_shutter, "name", rolling_shutter) != "GLOBAL":
        raise refuse("rolling_shutter", rolling_shutter, "GLOBAL, the one that clsplat.torch has")
    check_choice("camera_model", camera_model, CAMERA_MODELS)
    check_choice("render_mode", render_mode, RENDER_MODES)
    check_choice("rasterize_mode", rasterize_mode, RASTERIZE_MODES)
    width, height = check_size("width", width), check_size("height", height)
    tile_size = TILE_SIZE if tile_size is None else check_size("tile_size", tile_size)
    depth_alone = render_mode in {"D", "ED"}
    if colors is None and depth_alone:
        sh_degree, backgrounds = None, None
        colors = torch.zeros(*opacities.shape, 1) if isinstance(opacities, Tensor) else colors
    batch = _check_tensors(means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, covars, sh_degree)
    sh_degree = None if sh_degree is None else whole(sh_degree)
    if sparse_grad and (batch or not packed):
        raise refuse("sparse_grad", sparse_grad, "False with batches, and where packed is False")
    settings: dict[str, Any] = {
        "width": width,
        "height": height,
        "near_plane": check_number("near_plane", near_plane),
        "far_plane": check_number("far_plane", far_plane),
        "radius_clip": check_number("radius_clip", radius_clip, 0),
        "eps2d": check_number("eps2d", eps2d, 0),
        "alpha_max": check_number("alpha_max", alpha_max, 1 / 255, 1 - 1e-6),
        "sh_degree": sh_degree,
        "render_mode": render_mode,
        "rasterize_mode": rasterize_mode,
        "camera_model": camera_model,
        "absolute_gradients": absgrad,
        "differentiable": torch.is_grad_enabled(),
        "device": device,
    }
    backgrounds = None if depth_alone else backgrounds
    if covars is not None:
        quats = scales = None
    tensors = {
        "means": means,
        "quaternions": quats,
        "scales": scales,
        "opacities": opacities,
        "colors": colors,
        "viewmats": viewmats,
        "intrinsics": Ks,
        "backgrounds": backgrounds,
        "covars": covars,
    }
    settings["differentiable"] &= any(each is not None and each.requires_grad for each in tensors.values())
    dual = any(each is not None and forward_ad.unpack_dual(each).tangent is not None for each in tensors.values())
    arrays = {name: Batches(each, batch) for name, each in tensors.items()}
    with renamed(quaternions="quats", intrinsics="Ks"):
        results = [
            rasterize(**{name: each[index] for name, each in arrays.items()}, **settings)
            for index in range(math.prod(batch))
        ]
    expected = render_mode.endswith("ED")
    call = Call(results, batch, packed=packed, sparse=sparse_grad, absolute=absgrad, expected_depth=expected)
    if not settings["differentiable"] and not dual:  # of a dual tensor PyTorch says that there is no derivative
        return *call.pixels(means), _meta(call, means, None, width, height, tile_size)
    if covars is not None:
        covars = sparse_upper(covars) if sparse_grad else covars[..., UPPER[0], UPPER[1]]
    coefficients = None if sh_degree is None or depth_alone else colors
    *splats, colors2d = Projection.apply(call, means, quats, scales, covars, opacities, coefficients, viewmats, Ks)
    values = None if depth_alone else colors if sh_degree is None else colors2d
    images, alphas = Pixels.apply(call, *splats, values, backgrounds)
    return images, alphas, _meta(call, means, splats, width, height, tile_size)


def _refuse_missing(**given: Any) -> None:
    for name, value in given.items():
        if value is not None and value is not False:
            found = str(value) if isinstance(value, bool) else "given"
            wanted = "False" if isinstance(value, bool) else "None"
            raise refuse(name, found, f"{wanted}: clsplat.torch does not have it")


def _check_tensors(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Any,
    viewmats: Tensor,
    Ks: Tensor,  # noqa: N803
    backgrounds: Tensor | None,
    covars: Tensor | None,
    sh_degree: int | None,
) -> tuple[int, ...]:
    """The sizes of batches. Raises InputError for what is none of the shapes in `rasterization`, or has NaN."""
    leading = means.shape[:-2] if isinstance(means, Tensor) and means.dim() >= 2 else ()
    check_shape("means", means, (*leading, "N", 3))
    batch, count = tuple(leading), means.shape[-2]
    if covars is None:
        check_shape("quats", quats, (*batch, count, 4))
        check_shape("scales", scales, (*batch, count, 3))
    else:
        check_shape("covars", covars, (*batch, count, 3, 3))
    check_shape("opacities", opacities, (*batch, count))
    check_shape("viewmats", viewmats, (*batch, "C", 4, 4))
    cameras = viewmats.shape[-3]
    if cameras == 0 or 0 in batch:
        raise refuse("viewmats", f"of shape {tuple(viewmats.shape)}", "a camera or more in each batch")
    check_shape("Ks", Ks, (*batch, cameras, 3, 3))
    if sh_degree is None:
        check_shape("colors", colors, (*batch, count, "D"), (*batch, cameras, count, "D"))
        if colors.shape[-1] == 0:
            raise refuse("colors", "of 0 channels", "1 or more")
    else:
        sh_degree = degree("sh_degree", sh_degree, HIGHEST, ", or None for colours")
        check_shape("colors", colors, (*batch, count, "K", 3), (*batch, cameras, count, "K", 3))
        if colors.shape[-2] < (sh_degree + 1) ** 2:
            raise refuse(
                "colors",
                f"of {colors.shape[-2]} coefficients",
                f"{(sh_degree + 1) ** 2} or more, for sh_degree {sh_degree}",
            )
    if backgrounds is not None:  # depths have none behind them, so that nothing else looks at its numbers then
        shape = (*batch, cameras, colors.shape[-1])
        check_shape("backgrounds", backgrounds, shape)
        check("backgrounds", backgrounds, shape)
    return batch


def _meta(call: Call, like: Tensor, splats: Sequence[Tensor] | None, width: int, height: int, tile_size: int) -> Meta:
    """gsplat's dictionary, in its order. like: a tensor of the device and kind of what is made later; splats: SPLATS
    with their gradient, or None if there is none, to make them when they are looked at."""
    batches, cameras, _ = call.sizes
    like = like.new_empty(0)  # the caller's own would live as long as the dictionary
    columns, rows = math.ceil(width / tile_size), math.ceil(height / tile_size)

    def ids() -> dict[str, Any]:
        return dict(zip(IDS, call.ids(like.device), strict=True))

    def radii() -> dict[str, Any]:
        return {"radii": torch.from_numpy(call.radii()).to(like.device)}

    def all_splats() -> dict[str, Any]:
        return dict(zip(SPLATS, call.splats(like) if splats is None else splats, strict=True))

    # none of these holds the dictionary: in a ring with it a call and its memory would wait for the collector
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

    meta = Meta(dict.fromkeys(IDS))
    if call.packed:
        meta.later(IDS, ids)
    meta.later(("radii",), radii)
    meta.later(("means2d", "depths", "conics", "opacities"), all_splats)
    meta.update({"tile_width": columns, "tile_height": rows})
    meta.later(("tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets"), tiles)
    meta.update({"width": width, "height": height, "tile_size": tile_size, "n_batches": batches, "n_cameras": cameras})
    return meta
