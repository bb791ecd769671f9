# SPDX-License-Identifier: Apache-2.0
"""Covariances of Gaussians, and their inverses: pure PyTorch, on the device of the tensors."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from clsplat.torch.arguments import check
from clsplat.torch.compile_guards import differentiable_once

UPPER_TRIANGLE_INDICES = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])
"""Row and column of each entry in the upper triangle of a 3x3 matrix, row by row."""


def quat_scale_to_covar_preci(
    quats: Tensor,
    scales: Tensor,
    compute_covar: bool = True,
    compute_preci: bool = True,
    triu: bool = False,
) -> tuple[Tensor | None, Tensor | None]:
    """Compute covariance R S S^T R^T and precision R S^-1 S^-T R^T of each Gaussian, like gsplat 1.5.3's function.

    Parameters
    ----------
    quats : (..., 4) Tensor
        w, x, y, z, of any length over 0.
    scales : (..., 3) Tensor
        Standard deviations along the axes, in units of the scene. Precisions need scales above 0.
    compute_covar, compute_preci : bool
        Whether to compute covariances and precisions.
    triu : bool
        Return the upper triangles, row by row.

    Returns
    -------
    covariances, precisions : (..., 3, 3) or (..., 6) Tensor, or None
        (..., 6) with `triu`; None if not requested. Both can be differentiated any number of times.

    Raises
    ------
    InputError
        If a shape is wrong or there is a NaN; it names the argument.

    Notes
    -----
    Kerbl et al. 2023, eq. (6); gsplat 1.5.3's function of this name.
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
    """The upper triangles (N, 6) of matrices (N, 3, 3).

    If the gradient with respect to the triangles is a COO tensor, so is the gradient with respect to the matrices.
    """
    upper: Tensor = _SparseUpper.apply(covars)
    return upper


class _SparseUpper(torch.autograd.Function):  # type: ignore[misc]  # torch has no types here
    @staticmethod
    def forward(_: Any, covars: Tensor) -> Tensor:
        return covars[..., UPPER_TRIANGLE_INDICES[0], UPPER_TRIANGLE_INDICES[1]]

    @staticmethod
    @differentiable_once
    def backward(_: Any, gradient: Tensor) -> Tensor:
        rows = gradient.coalesce().values() if gradient.is_sparse else gradient
        matrices = rows.new_zeros(len(rows), 3, 3)
        matrices[:, UPPER_TRIANGLE_INDICES[0], UPPER_TRIANGLE_INDICES[1]] = rows
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
    return (
        matrices[..., UPPER_TRIANGLE_INDICES[0], UPPER_TRIANGLE_INDICES[1]]
        if matrices is not None and triu
        else matrices
    )
