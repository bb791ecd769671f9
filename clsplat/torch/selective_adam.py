# SPDX-License-Identifier: Apache-2.0
"""Adam that updates only the Gaussians in view: pure PyTorch, on the device of the tensors."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from clsplat.torch.arguments import refuse


class SelectiveAdam(torch.optim.Adam):  # type: ignore[misc]  # torch has no types here
    """Adam that updates only rows in view, without bias correction: gsplat 1.5.3's class of this name.

    Rows out of view keep their values and moments.

    Parameters
    ----------
    params : iterable
        Parameter groups, as for `torch.optim.Adam`, one tensor per group, with Gaussians along the first axis.
    eps : float
        Added to the root of the second moment.
    betas : (float, float)
        Decay of the first and the second moment.

    Notes
    -----
    Mallick et al. 2024, "Taming 3DGS".
    """

    def __init__(self, params: Iterable[Any], eps: float, betas: tuple[float, float]) -> None:
        super().__init__(params=params, eps=eps, betas=betas)

    def step(self, visibility: Tensor) -> None:
        """Take one step for the rows in view.

        Parameters
        ----------
        visibility : (N,) Tensor
            Rows where it is not 0 are updated.

        Raises
        ------
        InputError
            If a group has more than one tensor, or a tensor does not have N rows.
        """
        rows = visibility.flatten().bool()
        for group in self.param_groups:
            if len(group["params"]) != 1:
                raise refuse("params", f"a group of {len(group['params'])} tensors", "one tensor in each group")
            (parameter,) = group["params"]
            if parameter.grad is None:
                continue
            if parameter.dim() == 0 or len(parameter) != len(rows):
                found = f"of shape {tuple(visibility.shape)}"
                raise refuse("visibility", found, f"{len(parameter)} numbers, one for each row")
            with torch.no_grad():
                self._update(parameter, rows, group)

    def _update(self, parameter: Tensor, rows: Tensor, group: dict[str, Any]) -> None:
        """Update the rows of one tensor for which `rows` (N,) is True."""
        state = self.state[parameter]
        if not state:
            state["step"] = torch.tensor(0.0)
            state["exp_avg"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
            state["exp_avg_sq"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
        first, second = state["exp_avg"], state["exp_avg_sq"]
        beta1, beta2 = group["betas"]
        chosen = rows.nonzero()[:, 0]
        gradient = parameter.grad
        gradient = gradient.coalesce().to_dense() if gradient.is_sparse else gradient
        gradient = gradient[chosen]
        first_rows = torch.lerp(gradient, first[chosen], beta1)
        second_rows = torch.lerp(gradient * gradient, second[chosen], beta2)
        first[chosen] = first_rows
        second[chosen] = second_rows
        parameter[chosen] -= group["lr"] * first_rows / (second_rows.sqrt() + group["eps"])
