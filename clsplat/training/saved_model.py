# SPDX-License-Identifier: Apache-2.0
"""The Gaussians of a checkpoint, read from its arrays or from its scratch file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from typing import Any

from clsplat.chunks.store import ChunkStore
from clsplat.runs.checkpoints import Checkpoint, unusable
from clsplat.stages.device_gaussians import KINDS, HostGaussians, SavedArray, host_model, saved_models


@contextmanager
def saved_model(checkpoint: Checkpoint, sh_degree: int) -> Iterator[tuple[list[HostGaussians], Checkpoint]]:
    """Context with parameters, first and second moments of a checkpoint, and the checkpoint with all its arrays.

    sh_degree: final SH degree of the training.
    A scratch file that has some of them is open in the context. Raises InputError for arrays of another model.
    """
    saved: Mapping[str, Any] = {}
    with ExitStack() as reading:
        try:
            if checkpoint.manifest is not None:
                store = reading.enter_context(closing(ChunkStore.opened(checkpoint.manifest, writable=False)))
                models = saved_models(store)
                saved = {name: SavedArray(store, name) for name in store.fields}
            else:
                models = [host_model(checkpoint.arrays, kind) for kind in KINDS]
            n, most = max(model.coefficients for model in models), (sh_degree + 1) ** 2
            if n > most:
                raise ValueError(f"has {n} SH coefficients, more than the {most} of --sh-degree {sh_degree}")
        except ValueError as error:
            raise unusable(checkpoint, str(error)) from None
        yield models, replace(checkpoint, arrays={**checkpoint.arrays, **saved})
