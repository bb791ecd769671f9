# SPDX-License-Identifier: Apache-2.0
"""`fully_fused_projection`: Gaussians on the images of cameras, by gsplat's call, with the gradient."""

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from torch import Tensor

from clsplat.device.context import Device
from clsplat.library.projection import fully_fused_projection as library_projection
from clsplat.torch.arguments import as_tensor, check_choice, check_shape, check_size, refuse, renamed
from clsplat.torch.autograd import Batches, Call
from clsplat.torch.graphs import differentiable_once, outside_graphs

CAMERA_MODELS = ("pinhole", "ortho", "fisheye")
INPUTS = ("means", "quaternions", "scales", "covars", "viewmats", "intrinsics")
"""Names of the gradients in the library's vector-Jacobian product, in the order of `_Projection.forward`."""
OUTPUTS = ("means2d", "depths", "conics", "compensations")


@outside_graphs
def fully_fused_projection(
    means: Tensor,
    covars: Tensor | None,
    quats: Tensor | None,
    scales: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,  # noqa: N803  # gsplat's name
    width: int,
    height: int,
    eps2d: float = 0.3,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    packed: bool = False,
    sparse_grad: bool = False,
    calc_compensations: bool = False,
    camera_model: Literal["pinhole", "ortho", "fisheye", "ftheta"] = "pinhole",
    opacities: Tensor | None = None,
    *,
    device: Device | str | None = None,
) -> tuple[Tensor | None, ...]:
    """N Gaussians on the images of C cameras, as gsplat 1.5.3's function of this name; `...` are batches.

    means: (..., N, 3). Either covars: (..., N, 6), upper triangles xx, xy, xz, yy, yz, zz; or quats: (..., N, 4), w x y
    z, of any length, and scales: (..., N, 3), over 0. viewmats: (..., C, 4, 4), camera from world. Ks: (..., C, 3, 3),
    in pixels. width, height: pixels. eps2d: pixels^2, added to each variance. near_plane, far_plane: depths between
    which a Gaussian is in view. radius_clip: pixels; a splat of no larger radius is not. calc_compensations: the square
    root of the covariance's determinant without eps2d over that with it. opacities: (..., N), in [0, 1]; with them
    radii end where alpha is 1/255. device: an OpenCL device, open or as `clsplat devices` lists it.

    Returns radii (..., C, N, 2) int32, pixels, 0 where not in view; means2d (..., C, N, 2), pixels, the first pixel's
    centre at 0.5; depths (..., C, N); conics (..., C, N, 3), the inverse covariance's xx, xy, yy; compensations (...,
    C, N), or None. With `packed` batch_ids, camera_ids and gaussian_ids (nnz,) int64 come first, and the others are
    (nnz, ...), of the splats in view. With sparse_grad too, without batches, the gradients by means, covars, quats and
    scales are COO tensors of the rows in view.

    Raises InputError, which names the argument, for other shapes, numbers that are not finite, and the model ftheta.
    """
    check_choice("camera_model", camera_model, CAMERA_MODELS)
    width, height = check_size("width", width), check_size("height", height)
    leading = tuple(means.shape[:-2]) if isinstance(means, Tensor) and means.dim() >= 2 else ()
    check_shape("means", means, (*leading, "N", 3))
    count = means.shape[-2]
    if covars is None:
        check_shape("quats", quats, (*leading, count, 4))
        check_shape("scales", scales, (*leading, count, 3))
    else:
        check_shape("covars", covars, (*leading, count, 6))
        quats = scales = None
    check_shape("viewmats", viewmats, (*leading, "C", 4, 4))
    check_shape("Ks", Ks, (*leading, viewmats.shape[-3], 3, 3))
    if viewmats.shape[-3] == 0 or 0 in leading:
        raise refuse("viewmats", f"of shape {tuple(viewmats.shape)}", "a camera or more in each batch")
    if opacities is not None:
        check_shape("opacities", opacities, (*leading, count))
    if sparse_grad and (leading or not packed):
        raise refuse("sparse_grad", sparse_grad, "False with batches, and where packed is False")
    settings: dict[str, Any] = {
        "width": width,
        "height": height,
        "eps2d": eps2d,
        "near_plane": near_plane,
        "far_plane": far_plane,
        "radius_clip": radius_clip,
        "calc_compensations": calc_compensations,
        "camera_model": camera_model,
        "device": device,
    }
    tensors = {
        "means": means,
        "covars": covars,
        "quaternions": quats,
        "scales": scales,
        "viewmats": viewmats,
        "intrinsics": Ks,
        "opacities": opacities,
    }
    arrays = {name: Batches(each, leading) for name, each in tensors.items()}
    with renamed(quaternions="quats", intrinsics="Ks"):
        results = [
            library_projection(**{name: each[index] for name, each in arrays.items()}, **settings)
            for index in range(math.prod(leading))
        ]
    call = Call(results, leading, packed=packed, sparse=sparse_grad)
    splats = _Projection.apply(call, means, quats, scales, covars, viewmats, Ks)
    radii = torch.from_numpy(call.radii()).to(means.device)
    return (*call.ids(means.device), radii, *splats) if packed else (radii, *splats)


class _Projection(torch.autograd.Function):  # type: ignore[misc]  # torch has no types here
    @staticmethod
    def forward(ctx: Any, call: Call, *given: Tensor | None) -> tuple[Tensor | None, ...]:
        ctx.call = call
        ctx.save_for_backward(*given)
        ctx.set_materialize_grads(False)
        (means, *_), result = given, call.results[0]
        assert means is not None
        return tuple(
            None if getattr(result, name) is None else as_tensor(call.laid_out(call.stacked(name)), means)
            for name in OUTPUTS
        )

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, *given: Tensor | None) -> tuple[Any, ...]:
        call: Call = ctx.call
        inputs = dict(zip(INPUTS, ctx.saved_tensors, strict=True))
        if all(gradient is None for gradient in given):
            return (None,) * (1 + len(inputs))
        splats = {name: call.whole(name, gradient) for name, gradient in zip(OUTPUTS, given, strict=True)}
        each = [
            result.vjp(**{name: None if whole is None else whole[index] for name, whole in splats.items()})
            for index, result in enumerate(call.results)
        ]
        return (None, *call.gradients(each, inputs, ctx.needs_input_grad[1:]))
