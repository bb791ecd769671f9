# SPDX-License-Identifier: Apache-2.0
"""Mattes of a job: which objects there are, and of which each Gaussian is. Without a device."""

from __future__ import annotations

import hashlib
from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from clsplat.config.channels import MATTES
from clsplat.errors import InputError
from clsplat.frame.objects import Matte
from clsplat.models.formats import unpacked
from clsplat.models.formats.ply import read_whole_numbers
from clsplat.sequence.cast import Cast
from clsplat.sequence.task import MatteNames

MOST_OBJECTS = 256
"""Objects of a matte: each is a plane of floats while a frame is made."""


def mattes_of(cast: Cast, channels: Collection[str], ids_from: str = "") -> dict[str, Matte]:
    """The mattes among the channels, by their names; ids_from: the property of the models' files that semantic ids
    are of. Raises InputError."""
    made = {}
    if cast.changing and (asked := [name for name in MATTES if name in channels]):
        raise InputError(
            f"--channels {asked[0]}: {cast.path} changes over time, expected models whose Gaussians stay the same"
        )
    if "objects" in channels:
        made["objects"] = _objects(cast)
    if "semantic" in channels:
        made["semantic"] = _semantic(cast, ids_from)
    for name, matte in made.items():
        if len(matte.names) > MOST_OBJECTS:
            raise InputError(f"--channels {name}: has {len(matte.names):,} objects, expected at most {MOST_OBJECTS}")
    return made


def names_of(mattes: dict[str, Matte]) -> tuple[MatteNames, ...]:
    """The mattes as the options of a job tell of them."""
    return tuple(
        MatteNames(name, mattes[name].names, hashlib.sha256(mattes[name].owners.tobytes()).hexdigest()[:32])
        for name in MATTES
        if name in mattes
    )


def _objects(cast: Cast) -> Matte:
    """An object for each model, and one for each of its volumes, which go before it."""
    names, owners = list(cast.names), []
    for index, model in enumerate(cast.still):
        own = np.full(len(model), index, np.int32)
        for volume in reversed(cast.volumes[index] if cast.volumes else ()):  # the first counts
            own[volume.holds(model)] = len(names)
            names.append(volume.name)
        owners.append(own)
    return Matte(tuple(names), np.concatenate(owners))


def _semantic(cast: Cast, ids_from: str) -> Matte:
    """An object for each number that the property has."""
    if not cast.files:
        raise InputError(f"--ids-from {ids_from}: {cast.path} is a stage, expected PLY files that have the property")
    columns: list[NDArray[np.int64]] = []
    for file, model in zip(cast.files, cast.still, strict=True):
        with unpacked(file) as (opened, form):
            if form.name != "3DGS PLY":
                found = f"{file} is {form.name}, expected a 3DGS PLY that has the property"
                raise InputError(f"--ids-from {ids_from}: {found}")
            columns.append(read_whole_numbers(opened, ids_from))
        assert len(columns[-1]) == len(model)
    numbers, owners = np.unique(np.concatenate(columns), return_inverse=True)
    return Matte(tuple(str(number) for number in numbers.tolist()), owners.astype(np.int32))
