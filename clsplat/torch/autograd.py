# SPDX-License-Identifier: Apache-2.0
"""The two autograd functions of `rasterization`: projection of Gaussians to splats, and blending to pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from clsplat.arrays import Int64
from clsplat.library.projection import stacked
from clsplat.torch.arguments import as_array, as_tensor
from clsplat.torch.compile_guards import differentiable_once
from clsplat.torch.covariances import UPPER_TRIANGLE_INDICES

SPARSE_GRADIENT_ARGUMENTS = ("means", "quaternions", "scales", "covars")
"""Arguments whose gradients may be sparse."""
PROJECTED_SPLAT_NAMES = ("means2d", "conics", "depths", "opacities")
"""Names of the splat arrays that `ProjectionFunction` returns."""

RASTERIZATION_INPUTS = ("means", "quaternions", "scales", "covars", "opacities", "colors", "viewmats", "intrinsics")
"""Names of the inputs of `ProjectionFunction`, in order. `Rasterization.vjp_projection` names gradients by them."""


class Batches:
    """A tensor as a sequence of arrays, one for each batch; a sequence of None if the tensor is None.

    batch: sizes of the tensor's leading axes, which are the batches.
    """

    def __init__(self, value: Tensor | None, batch: tuple[int, ...]) -> None:
        array = None if value is None else as_array(value)
        self.array = None if array is None else array.reshape(math.prod(batch), *array.shape[len(batch) :])

    def __getitem__(self, index: int) -> Any:
        return None if self.array is None else self.array[index]


class BatchResults:
    """Results of a call of gsplat's function: the library's result for each batch, and the splats in view.

    In the layout of `meta`, the third result of `rasterization`, arrays are (*batch, C, N, ...). With `packed` they are
    (nnz, ...), a row for each splat in view.
    A splat's index is its position in a flattened array (B, C, N): by batch, then camera, then Gaussian.

    batch: sizes of the batch axes. B is their product.
    sparse: make gradients with respect to SPARSE_GRADIENT_ARGUMENTS COO tensors.
    absolute: let the backward pass set `means2d.absgrad`.
    expected_depth: True if the images have expected depth, whose gradient reads the images.
    """

    def __init__(
        self,
        results: Sequence[Any],
        batch: tuple[int, ...],
        *,
        packed: bool,
        sparse: bool = False,
        absolute: bool = False,
        expected_depth: bool = False,
    ) -> None:
        self.results, self.batch, self.packed, self.sparse, self.absolute = results, batch, packed, sparse, absolute
        self.expected_depth = expected_depth
        self._handed_on: dict[str, tuple[Tensor, int, NDArray[Any]]] = {}
        self.sizes = (len(results), *results[0].depths.shape)

    @cached_property
    def in_view(self) -> Int64 | None:
        """Indices of the splats in view; None unless packed."""
        if not self.packed:
            return None
        radii = self.stacked("radii")  # the columns are compared separately: np.all over them takes ten times as long
        return np.flatnonzero((radii[..., 0] > 0) & (radii[..., 1] > 0))

    def splats(self, like: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The splats' means2d, conics, depths and opacities, with the device and dtype of `like`.

        Shapes are (..., C, N, ...), or (nnz, ...) with a row for each splat in view if packed.
        """
        arrays = (self.laid_out(self.stacked(name)) for name in PROJECTED_SPLAT_NAMES)
        means2d, conics, depths, opacities = (as_tensor(array, like) for array in arrays)
        return means2d, conics, depths, opacities

    def radii(self) -> NDArray[np.int32]:
        """A copy of the radii (..., C, N, 2), or (nnz, 2) if packed; the gradient reads the original array later."""
        radii = self.laid_out(self.stacked("radii"))
        return radii if self.packed else radii.copy()

    def ids(self, device: Any) -> tuple[Tensor, Tensor, Tensor]:
        """Batch, camera and Gaussian index of each splat in view, int64."""
        assert self.in_view is not None
        number, cameras, count = self.sizes
        if number == cameras == 1:
            batches, places, gaussians = np.zeros_like(self.in_view), np.zeros_like(self.in_view), self.in_view.copy()
        else:
            images, gaussians = np.divmod(self.in_view, max(count, 1))
            batches, places = np.divmod(images, cameras)
        first, second, third = (torch.from_numpy(each).to(device) for each in (batches, places, gaussians))
        return first, second, third

    def stacked(self, name: str) -> NDArray[Any]:
        """The array `name` from the results of all batches, (B, ...)."""
        return stacked([getattr(result, name) for result in self.results])

    def by_camera(self, name: str) -> NDArray[Any]:
        """The array `name` from the results of all batches, with the call's batch axes: (..., C, ...)."""
        array = self.stacked(name)
        return array.reshape(*self.batch, *array.shape[1:])

    def pixels(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Images and alphas, with the device and dtype of `like`."""
        return as_tensor(self.by_camera("images"), like), as_tensor(self.by_camera("alphas"), like)

    def of_rows(self, gradient: Tensor) -> Tensor:
        """Convert a gradient (N, ...) to a COO tensor that has only the rows of Gaussians in view."""
        assert self.in_view is not None
        rows = torch.from_numpy(np.unique(self.in_view % self.sizes[2])).to(gradient.device)
        return torch.sparse_coo_tensor(
            rows[None], gradient[rows], gradient.shape, is_coalesced=True, check_invariants=False
        )

    def laid_out(self, array: NDArray[Any]) -> NDArray[Any]:
        """Convert an array (B, C, N, ...) to the layout of `meta`: (..., C, N, ...), or (nnz, ...) if packed."""
        if self.in_view is None:
            return array.reshape(*self.batch, *array.shape[1:])
        return array.reshape(-1, *array.shape[3:]).take(self.in_view, axis=0)

    def whole(self, name: str, value: Tensor | None) -> Any:
        """Convert the gradient `value` with respect to the array `name` from the layout of `meta` to (B, C, N, ...).

        If `in_layout` made the tensor, and PyTorch's version counter shows no change, this returns the array from which
        the tensor was made.
        """
        packed, version, array = self._handed_on.pop(name, (None, 0, None))
        if value is None:
            return None
        if packed is not None and _is_same(value, packed) and value._version == version:  # noqa: SLF001
            return array
        array = as_array(value)
        if self.in_view is None:
            return array.reshape(*self.sizes, *array.shape[len(self.batch) + 2 :])
        rows = array
        if len(array) < math.prod(self.sizes):
            rows = np.zeros((math.prod(self.sizes), *array.shape[1:]), np.float32)
            # copy each row as one item of bytes, which takes half the time
            one = np.dtype((np.void, array.itemsize * math.prod(array.shape[1:])))
            rows.reshape(-1).view(one)[self.in_view] = array.reshape(-1).view(one)
        return rows.reshape(*self.sizes, *array.shape[1:])

    def gradient(self, each: list[dict[str, Any]], name: str, like: Tensor | None) -> Tensor | None:
        """Return the gradient with respect to the argument `like`, with its shape and dtype.

        each: for each batch, the gradients by name. name: the gradient's name.
        Returns None if `like` is None, or if a batch has no gradient of this name.
        """
        if like is None or any(found.get(name) is None for found in each):
            return None
        arrays = [found[name] for found in each]
        array = arrays[0] if len(arrays) == 1 else np.stack(arrays)
        return as_tensor(np.ascontiguousarray(array).reshape(like.shape), like)

    def gradients(
        self, each: list[dict[str, Any]], inputs: dict[str, Tensor | None], needed: Sequence[bool]
    ) -> list[Tensor | None]:
        """Return the gradient with respect to each of the `inputs`; None for an input whose gradient is not needed.

        each: for each batch, the gradients by name. needed: for each input, True if its gradient is needed.
        If the call is sparse, gradients with respect to SPARSE_GRADIENT_ARGUMENTS have only the rows in view.
        """
        found = [
            self.gradient(each, name, like) if wanted else None
            for (name, like), wanted in zip(inputs.items(), needed, strict=True)
        ]
        if not self.sparse:
            return found
        pairs = zip(inputs, found, strict=True)
        return [
            self.of_rows(part) if part is not None and name in SPARSE_GRADIENT_ARGUMENTS else part
            for name, part in pairs
        ]

    def in_layout(self, each: list[dict[str, Any]], name: str, like: Tensor, *, hand_on: bool) -> Tensor:
        """Return the gradient with respect to an array of splats, from all batches, in the layout of `meta`.

        each: for each batch, the gradients by name. name: the array's name. like: the array as a tensor.
        hand_on: with `packed`, keep the array, so that `whole` can return it. It is not kept if `like` has hooks, as a
        hook could change the tensor without a new version.
        """
        arrays = [found[name] for found in each]
        array = stacked(arrays)
        tensor = as_tensor(self.laid_out(array), like)
        if self.packed and hand_on and not like._backward_hooks and not tensor.is_inference():  # noqa: SLF001
            self._handed_on[name] = (tensor, tensor._version, array)  # noqa: SLF001
        return tensor


def item(whole: NDArray[Any] | None, index: int) -> NDArray[Any] | None:
    """The part of an array for batch `index`; None if there is no array."""
    return None if whole is None else whole[index]


def _is_same(one: Tensor, other: Tensor) -> bool:
    """True if both tensors have the same memory, shape, strides and dtype."""
    if one.is_sparse or one.data_ptr() != other.data_ptr():
        return False
    return bool(one.shape == other.shape and one.stride() == other.stride() and one.dtype == other.dtype)


class ProjectionFunction(torch.autograd.Function):  # type: ignore[misc]  # torch has no types here
    """Autograd function that projects Gaussians to splats. Splats are (..., C, N, ...), or (nnz, ...) if packed."""

    @staticmethod
    def forward(ctx: Any, call: BatchResults, *inputs: Tensor | None) -> tuple[Tensor | None, ...]:
        """The splats' means2d, conics, depths and opacities, and their colours (..., C, N, 3) from SH coefficients.

        Without SH coefficients the colours are None.

        inputs: the tensors that RASTERIZATION_INPUTS names. covars are upper triangles; colors are None unless they are
        SH coefficients.
        """
        ctx.call = call
        ctx.save_for_backward(*inputs)
        ctx.set_materialize_grads(False)
        given = dict(zip(RASTERIZATION_INPUTS, inputs, strict=True))
        means = given["means"]
        assert means is not None
        colors = None if given["colors"] is None else as_tensor(call.by_camera("colors2d"), means)
        return (*call.splats(means), colors)

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, *given: Tensor | None) -> tuple[Any, ...]:
        """Gradients with respect to the arguments of `forward`."""
        call: BatchResults = ctx.call
        inputs = dict(zip(RASTERIZATION_INPUTS, ctx.saved_tensors, strict=True))
        if all(gradient is None for gradient in given):
            return (None,) * (1 + len(inputs))
        means2d, conics, depths, opacities = (
            call.whole(name, gradient) for name, gradient in zip(PROJECTED_SPLAT_NAMES, given[:4], strict=True)
        )
        colors = None if given[4] is None else as_array(given[4]).reshape(*call.sizes, given[4].shape[-1])
        cameras = any(ctx.needs_input_grad[-2:])
        each = []
        for index, result in enumerate(call.results):
            found = result.vjp_projection(
                means2d=item(means2d, index),
                conics=item(conics, index),
                opacities=item(opacities, index),
                colors2d=item(colors, index),
                depths=item(depths, index),
                cameras=cameras,
            )
            if "covars" in found:  # off-diagonal entries are twice in the matrix: add both gradients, which are equal
                found["covars"] = found["covars"][:, UPPER_TRIANGLE_INDICES[0], UPPER_TRIANGLE_INDICES[1]] * np.array(
                    [1, 2, 2, 1, 2, 1], np.float32
                )
            each.append(found)
        return (None, *call.gradients(each, inputs, ctx.needs_input_grad[1:]))


class PixelsFunction(torch.autograd.Function):  # type: ignore[misc]  # torch has no types here
    """Autograd function that blends splats, (..., C, N, ...) or (nnz, ...) if packed, to images and alphas."""

    @staticmethod
    def forward(
        ctx: Any,
        call: BatchResults,
        means2d: Tensor,
        conics: Tensor,
        depths: Tensor,
        opacities: Tensor,
        values: Tensor | None,
        backgrounds: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """Images (..., C, H, W, X) and alphas (..., C, H, W, 1) of the splats.

        values: values to blend, (..., N, D) or (..., C, N, D); None if only depth is rendered.
        """
        ctx.call = call
        images, alphas = call.pixels(means2d)
        # the backward pass reads these outputs; as they are saved, PyTorch raises an error if they change in place
        read = (images, alphas) if call.expected_depth else (alphas,)
        ctx.save_for_backward(means2d, conics, depths, opacities, values, backgrounds, *read)
        ctx.set_materialize_grads(False)
        return images, alphas

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, d_images: Tensor | None, d_alphas: Tensor | None) -> tuple[Any, ...]:
        """Gradients with respect to the arguments of `forward`."""
        call: BatchResults = ctx.call
        means2d, conics, depths, opacities, values, backgrounds, *_ = ctx.saved_tensors
        if d_images is None and d_alphas is None:
            return (None,) * 7
        each = []
        images, alphas = Batches(d_images, call.batch), Batches(d_alphas, call.batch)
        for index, result in enumerate(call.results):
            image = np.zeros_like(result.images) if d_images is None else images[index]
            each.append(result.vjp_pixels(image, alphas[index]))
        hand_on = any(ctx.needs_input_grad[1:5])
        has_depths = all(found.get("depths") is not None for found in each)
        if call.absolute:
            means2d.absgrad = call.in_layout(each, "absolute", means2d, hand_on=False)
        if (
            values is not None and values.dim() == len(call.batch) + 2
        ):  # all cameras share the values: sum their gradients
            each = [{**found, "colors2d": found["colors2d"].sum(0)} for found in each]
        return (
            None,
            call.in_layout(each, "means2d", means2d, hand_on=hand_on),
            call.in_layout(each, "conics", conics, hand_on=hand_on),
            call.in_layout(each, "depths", depths, hand_on=hand_on) if has_depths else None,
            call.in_layout(each, "opacities", opacities, hand_on=hand_on),
            call.gradient(each, "colors2d", values),
            call.gradient(each, "backgrounds", backgrounds),
        )
