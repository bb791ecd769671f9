# SPDX-License-Identifier: Apache-2.0
"""The two functions of autograd that `rasterization` is made of: projection, and pixels."""

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
from clsplat.torch.covariances import UPPER
from clsplat.torch.graphs import differentiable_once

SPARSE = ("means", "quaternions", "scales", "covars")
"""Arguments whose gradients may be sparse."""
SPLATS = ("means2d", "conics", "depths", "opacities")
"""Names of the splats that `Projection` makes of Gaussians."""


class Batches:
    """A tensor's array, batch by batch; None throughout where it is None."""

    def __init__(self, value: Tensor | None, batch: tuple[int, ...]) -> None:
        array = None if value is None else as_array(value)
        self.array = None if array is None else array.reshape(math.prod(batch), *array.shape[len(batch) :])

    def __getitem__(self, index: int) -> Any:
        return None if self.array is None else self.array[index]


class Call:
    """Results of one call, of the library for each batch, and which of their splats are looked at.

    Splats are numbered through batches, cameras and Gaussians, (B, C, N).
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
        """Numbers of the splats in view; None unless packed."""
        if not self.packed:
            return None
        radii = self.stacked("radii")  # a column at a time: numpy takes ten times as long for an axis of two
        return np.flatnonzero((radii[..., 0] > 0) & (radii[..., 1] > 0))

    def splats(self, like: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """SPLATS in the layout of `meta`, of the device and kind of another tensor."""
        arrays = (self.laid_out(self.stacked(name)) for name in SPLATS)
        means2d, conics, depths, opacities = (as_tensor(array, like) for array in arrays)
        return means2d, conics, depths, opacities

    def radii(self) -> NDArray[np.int32]:
        """In the layout of `meta`; a copy each time, as the gradient reads the library's."""
        radii = self.laid_out(self.stacked("radii"))
        return radii if self.packed else radii.copy()

    def ids(self, device: Any) -> tuple[Tensor, Tensor, Tensor]:
        """Batch, camera and Gaussian of each splat in view, int64."""
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
        """A result of every batch, (B, ...)."""
        return stacked([getattr(result, name) for result in self.results])

    def by_camera(self, name: str) -> NDArray[Any]:
        """A result of every batch, (..., C, ...)."""
        array = self.stacked(name)
        return array.reshape(*self.batch, *array.shape[1:])

    def pixels(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Images and alphas, of the device and kind of another tensor."""
        return as_tensor(self.by_camera("images"), like), as_tensor(self.by_camera("alphas"), like)

    def of_rows(self, gradient: Tensor) -> Tensor:
        """A gradient (N, ...) as a COO tensor of the rows in view, each once."""
        assert self.in_view is not None
        rows = torch.from_numpy(np.unique(self.in_view % self.sizes[2])).to(gradient.device)
        return torch.sparse_coo_tensor(
            rows[None], gradient[rows], gradient.shape, is_coalesced=True, check_invariants=False
        )

    def laid_out(self, array: NDArray[Any]) -> NDArray[Any]:
        """(B, C, N, ...) in the layout of `meta`: (..., C, N, ...), or (nnz, ...) packed."""
        if self.in_view is None:
            return array.reshape(*self.batch, *array.shape[1:])
        return array.reshape(-1, *array.shape[3:]).take(self.in_view, axis=0)

    def whole(self, name: str, value: Tensor | None) -> Any:
        """A gradient in the layout of `meta`, as (B, C, N, ...). What `in_layout` has packed is not spread again, if it
        is the same and by PyTorch's count of versions as it was."""
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
            # a row as one item, in half the time
            one = np.dtype((np.void, array.itemsize * math.prod(array.shape[1:])))
            rows.reshape(-1).view(one)[self.in_view] = array.reshape(-1).view(one)
        return rows.reshape(*self.sizes, *array.shape[1:])

    def gradient(self, each: list[dict[str, Any]], name: str, like: Tensor | None) -> Tensor | None:
        """Gradients of an argument from every batch, in the argument's own shape and kind."""
        if like is None or any(found.get(name) is None for found in each):
            return None
        arrays = [found[name] for found in each]
        array = arrays[0] if len(arrays) == 1 else np.stack(arrays)
        return as_tensor(np.ascontiguousarray(array).reshape(like.shape), like)

    def gradients(
        self, each: list[dict[str, Any]], inputs: dict[str, Tensor | None], needed: Sequence[bool]
    ) -> list[Tensor | None]:
        """Gradients of arguments, those that are needed; of SPARSE ones the rows in view, if they are to be sparse."""
        found = [
            self.gradient(each, name, like) if wanted else None
            for (name, like), wanted in zip(inputs.items(), needed, strict=True)
        ]
        if not self.sparse:
            return found
        pairs = zip(inputs, found, strict=True)
        return [self.of_rows(part) if part is not None and name in SPARSE else part for name, part in pairs]

    def in_layout(self, each: list[dict[str, Any]], name: str, like: Tensor, *, hand_on: bool) -> Tensor:
        """Gradients of splats from every batch, in the layout of `meta`; hand_on: `whole` will be asked for them, with
        what hooks make of them, which may change them uncounted."""
        arrays = [found[name] for found in each]
        array = stacked(arrays)
        tensor = as_tensor(self.laid_out(array), like)
        if self.packed and hand_on and not like._backward_hooks and not tensor.is_inference():  # noqa: SLF001
            self._handed_on[name] = (tensor, tensor._version, array)  # noqa: SLF001
        return tensor


def _is_same(one: Tensor, other: Tensor) -> bool:
    """True for one tensor, or two of the same numbers in the same places."""
    if one.is_sparse or one.data_ptr() != other.data_ptr():
        return False
    return bool(one.shape == other.shape and one.stride() == other.stride() and one.dtype == other.dtype)


class Projection(torch.autograd.Function):  # type: ignore[misc]  # torch has no types here
    """From Gaussians to splats in the layout of `meta`."""

    @staticmethod
    def forward(
        ctx: Any,
        call: Call,
        means: Tensor,
        quats: Tensor | None,
        scales: Tensor | None,
        covars: Tensor | None,
        opacities: Tensor,
        coefficients: Tensor | None,
        viewmats: Tensor,
        intrinsics: Tensor,
    ) -> tuple[Tensor | None, ...]:
        """SPLATS and, with coefficients, colours (..., C, N, 3)."""
        ctx.call = call
        ctx.save_for_backward(means, quats, scales, covars, opacities, coefficients, viewmats, intrinsics)
        ctx.set_materialize_grads(False)
        colors = None if coefficients is None else as_tensor(call.by_camera("colors2d"), means)
        return (*call.splats(means), colors)

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, *given: Tensor | None) -> tuple[Any, ...]:
        """Gradients of the arguments of `forward`."""
        call: Call = ctx.call
        inputs = dict(zip(INPUTS, ctx.saved_tensors, strict=True))
        if all(gradient is None for gradient in given):
            return (None,) * (1 + len(inputs))
        splats = {name: call.whole(name, gradient) for name, gradient in zip(SPLATS, given[:4], strict=True)}
        colors = given[4]
        splats["colors2d"] = None if colors is None else as_array(colors).reshape(*call.sizes, colors.shape[-1])
        cameras = any(ctx.needs_input_grad[-2:])
        each = []
        for index, result in enumerate(call.results):
            by = {name: None if whole is None else whole[index] for name, whole in splats.items()}
            found = result.vjp_projection(**by, cameras=cameras)
            if "covars" in found:  # one half of what a number off the diagonal stands for twice
                found["covars"] = found["covars"][:, UPPER[0], UPPER[1]] * np.array([1, 2, 2, 1, 2, 1], np.float32)
            each.append(found)
        return (None, *call.gradients(each, inputs, ctx.needs_input_grad[1:]))


INPUTS = ("means", "quaternions", "scales", "covars", "opacities", "colors", "viewmats", "intrinsics")
"""Names of the gradients in `Rasterization.vjp_projection`, in the order of `Projection.forward`."""


class Pixels(torch.autograd.Function):  # type: ignore[misc]  # torch has no types here
    """From splats in the layout of `meta` to images and alphas."""

    @staticmethod
    def forward(
        ctx: Any,
        call: Call,
        means2d: Tensor,
        conics: Tensor,
        depths: Tensor,
        opacities: Tensor,
        values: Tensor | None,
        backgrounds: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """Images (..., C, H, W, X) and alphas (..., C, H, W, 1); values: (..., N, D) or (..., C, N, D), or None."""
        ctx.call = call
        images, alphas = call.pixels(means2d)
        # outputs that the gradient reads too: to change them in place is an error then
        read = (images, alphas) if call.expected_depth else (alphas,)
        ctx.save_for_backward(means2d, conics, depths, opacities, values, backgrounds, *read)
        ctx.set_materialize_grads(False)
        return images, alphas

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, d_images: Tensor | None, d_alphas: Tensor | None) -> tuple[Any, ...]:
        """Gradients of the arguments of `forward`."""
        call: Call = ctx.call
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
        if values is not None and values.dim() == len(call.batch) + 2:  # one for all cameras
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
