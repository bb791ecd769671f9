# SPDX-License-Identifier: Apache-2.0
"""Covariances of Gaussians, and their inverses: plain PyTorch, on the tensors' own device."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from clsplat.torch.arguments import check
from clsplat.torch.graphs import differentiable_once

UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])
"""Rows and columns of the upper triangle of a 3x3 matrix, in the order of the flattened form."""


def quat_scale_to_covar_preci(
    quats: Tensor,
    scales: Tensor,
    compute_covar: bool = True,
    compute_preci: bool = True,
    triu: bool = False,
) -> tuple[Tensor | None, Tensor | None]:
    """Covariance R S S^T R^T and precision R S^-1 S^-T R^T of each Gaussian, as gsplat 1.5.3's function of this name.

    quats: (..., 4), w x y z, of any length over 0. scales: (..., 3), standard deviations along the axes, in units of
    the scene; over 0 where a precision is wanted. Returns both as (..., 3, 3), or as (..., 6), the upper triangle row
    by row, with `triu`; None for one that is not asked for. Both can be differentiated as often as one likes.

    Raises InputError, which names the argument, for other shapes and for NaN.
    """
    check("quats", quats, (*_leading(quats), 4))
    check("scales", scales, (*quats.shape[:-1], 3))
    rotations = rotation_matrices(quats)
    half = rotations * scales[..., None, :]
    covariances = half @ half.transpose(-1, -2) if compute_covar else None
    half = rotations / scales[..., None, :]
    precisions = half @ half.transpose(-1, -2) if compute_preci else None
    return _form(covariances, triu), _form(precisions, triu)


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotations (..., 3, 3) of quaternions (..., 4), w x y z, of any length over 0."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def sparse_upper(covars: Tensor) -> Tensor:
    """The upper triangles (N, 6) of matrices (N, 3, 3), by which a gradient may be a COO tensor of rows: that by the
    matrices is one too then."""
    upper: Tensor = _SparseUpper.apply(covars)
    return upper


class _SparseUpper(torch.autograd.Function):  # type: ignore[misc]  # torch has no types here
    @staticmethod
    def forward(_: Any, covars: Tensor) -> Tensor:
        return covars[..., UPPER[0], UPPER[1]]

    @staticmethod
    @differentiable_once
    def backward(_: Any, gradient: Tensor) -> Tensor:
        rows = gradient.coalesce().values() if gradient.is_sparse else gradient
        matrices = rows.new_zeros(len(rows), 3, 3)
        matrices[:, UPPER[0], UPPER[1]] = rows
        if not gradient.is_sparse:
            return matrices
        return torch.sparse_coo_tensor(
            gradient.coalesce().indices(),
            matrices,
            (len(gradient), 3, 3),
            is_coalesced=True,
            check_invariants=False,
        )


def _leading(value: object) -> tuple[int | str, ...]:
    return tuple(value.shape[:-1]) if isinstance(value, Tensor) and value.dim() else ("...",)


def _form(matrices: Tensor | None, triu: bool) -> Tensor | None:
    return matrices[..., UPPER[0], UPPER[1]] if matrices is not None and triu else matrices
