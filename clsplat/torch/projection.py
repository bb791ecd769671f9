# SPDX-License-Identifier: Apache-2.0
"""gsplat's `fully_fused_projection`: Gaussians projected to the images of cameras, with the gradient."""

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from torch import Tensor

from clsplat.device.context import Device
from clsplat.library.projection import fully_fused_projection as library_projection
from clsplat.stages.ewa import EWA_CAMERA_MODELS
from clsplat.torch.arguments import as_tensor, check_choice, check_shape, check_size, refuse, renamed
from clsplat.torch.autograd import Batches, BatchResults, item
from clsplat.torch.compile_guards import differentiable_once, outside_graphs

PROJECTION_INPUTS = ("means", "quaternions", "scales", "covars", "viewmats", "intrinsics")
"""Names of the inputs of `_Projection`, in order. The library's `vjp` names gradients by them."""
PROJECTION_OUTPUTS = ("means2d", "depths", "conics", "compensations")


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
    """Project N Gaussians to the images of C cameras, like gsplat 1.5.3's function of this name.

    The leading sizes `...` are batches.

    Parameters
    ----------
    means : (..., N, 3) Tensor
        World units.
    covars : (..., N, 6) Tensor or None
        Upper triangles xx, xy, xz, yy, yz, zz of covariances.
    quats : (..., N, 4) Tensor or None
        w, x, y, z, of any length over 0. Used if covars is None.
    scales : (..., N, 3) Tensor or None
        Standard deviations above 0 in world units. Used if covars is None.
    viewmats : (..., C, 4, 4) Tensor
        Camera from world.
    Ks : (..., C, 3, 3) Tensor
        Intrinsics in pixels.
    width, height : int
        Pixels.
    eps2d : float
        Low-pass filter in px^2, which is added to each variance on the image.
    near_plane, far_plane : float
        World units. Gaussians whose depth is not strictly between these are not in view.
    radius_clip : float
        Pixels. Splats whose radii are at most this are not in view.
    packed : bool
        Return only the splats in view.
    sparse_grad : bool
        Make the gradients of means, covars, quats and scales COO tensors of the rows in view. Requires `packed`, and no
        batches.
    calc_compensations : bool
        Also compute sqrt(det(covariance without eps2d) / det(covariance with eps2d)).
    camera_model : str
        "pinhole", "ortho" or "fisheye" (equidistant).
    opacities : (..., N) Tensor, optional
        0 to 1. If given, the radii end where alpha is 1/255.
    device : Device or str, optional
        An open OpenCL device, or a name as `clsplat devices` lists them.

    Returns
    -------
    batch_ids, camera_ids, gaussian_ids : (nnz,) Tensor of int64
        Only with `packed`. The other results are then (nnz, ...).
    radii : (..., C, N, 2) Tensor of int32
        Pixels; 0 if not in view.
    means2d : (..., C, N, 2) Tensor
        Pixels; the first pixel's centre is at 0.5.
    depths : (..., C, N) Tensor
        World units.
    conics : (..., C, N, 3) Tensor
        xx, xy, yy of the inverse covariance, 1 / px^2.
    compensations : (..., C, N) Tensor or None
        0 to 1; None unless calc_compensations is True.

    Raises
    ------
    InputError
        If a shape is wrong, numbers are not finite, or the camera model is ftheta; it names the argument.

    Notes
    -----
    Zwicker et al., EWA splatting, 2002; gsplat 1.5.3's function of this name.
    """
    check_choice("camera_model", camera_model, EWA_CAMERA_MODELS)
    width, height = check_size("width", width), check_size("height", height)
    leading = _check_tensors(means, covars, quats, scales, viewmats, Ks, opacities)
    if sparse_grad and (leading or not packed):
        raise refuse("sparse_grad", sparse_grad, "False, as there are batches or packed is False")
    if covars is not None:
        quats = scales = None
    given = (means, covars, quats, scales, viewmats, Ks, opacities)
    centres, shapes, turns, sizes, poses, lenses, covers = (Batches(each, leading) for each in given)
    with renamed(quaternions="quats", intrinsics="Ks"):
        results = [
            library_projection(
                centres[index],
                shapes[index],
                turns[index],
                sizes[index],
                poses[index],
                lenses[index],
                width,
                height,
                eps2d=eps2d,
                near_plane=near_plane,
                far_plane=far_plane,
                radius_clip=radius_clip,
                calc_compensations=calc_compensations,
                camera_model=camera_model,
                opacities=covers[index],
                device=device,
            )
            for index in range(math.prod(leading))
        ]
    call = BatchResults(results, leading, packed=packed, sparse=sparse_grad)
    splats = _Projection.apply(call, means, quats, scales, covars, viewmats, Ks)
    radii = torch.from_numpy(call.radii()).to(means.device)
    return (*call.ids(means.device), radii, *splats) if packed else (radii, *splats)


def _check_tensors(
    means: Tensor,
    covars: Tensor | None,
    quats: Tensor | None,
    scales: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,  # noqa: N803
    opacities: Tensor | None,
) -> tuple[int, ...]:
    """Check the shapes, and return the sizes of the batches. Raises InputError."""
    leading = tuple(means.shape[:-2]) if isinstance(means, Tensor) and means.dim() >= 2 else ()
    check_shape("means", means, (*leading, "N", 3))
    count = means.shape[-2]
    if covars is None:
        check_shape("quats", quats, (*leading, count, 4))
        check_shape("scales", scales, (*leading, count, 3))
    else:
        check_shape("covars", covars, (*leading, count, 6))
    check_shape("viewmats", viewmats, (*leading, "C", 4, 4))
    check_shape("Ks", Ks, (*leading, viewmats.shape[-3], 3, 3))
    if viewmats.shape[-3] == 0 or 0 in leading:
        raise refuse("viewmats", f"of shape {tuple(viewmats.shape)}", "at least one camera in each batch")
    if opacities is not None:
        check_shape("opacities", opacities, (*leading, count))
    return leading


class _Projection(torch.autograd.Function):  # type: ignore[misc]  # torch has no types here
    @staticmethod
    def forward(ctx: Any, call: BatchResults, *given: Tensor | None) -> tuple[Tensor | None, ...]:
        ctx.call = call
        ctx.save_for_backward(*given)
        ctx.set_materialize_grads(False)
        (means, *_), result = given, call.results[0]
        assert means is not None
        return tuple(
            None if getattr(result, name) is None else as_tensor(call.laid_out(call.stacked(name)), means)
            for name in PROJECTION_OUTPUTS
        )

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, *given: Tensor | None) -> tuple[Any, ...]:
        call: BatchResults = ctx.call
        inputs = dict(zip(PROJECTION_INPUTS, ctx.saved_tensors, strict=True))
        if all(gradient is None for gradient in given):
            return (None,) * (1 + len(inputs))
        means2d, depths, conics, compensations = (
            call.whole(name, gradient) for name, gradient in zip(PROJECTION_OUTPUTS, given, strict=True)
        )
        each = [
            result.vjp(item(means2d, index), item(depths, index), item(conics, index), item(compensations, index))
            for index, result in enumerate(call.results)
        ]
        return (None, *call.gradients(each, inputs, ctx.needs_input_grad[1:]))
