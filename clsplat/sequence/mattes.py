# SPDX-License-Identifier: Apache-2.0
"""Mattes of a job: its objects, and the object of each Gaussian. Needs no device."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from clsplat.config.channels import CRYPTOMATTE_CHANNELS
from clsplat.errors import InputError
from clsplat.frame.mattes import Matte
from clsplat.models.formats import unpacked
from clsplat.models.formats.ply import read_whole_numbers
from clsplat.sequence.job_models import JobModels
from clsplat.sequence.task import MatteNames

MAX_MATTE_OBJECTS = 256
"""Limit of objects in a matte. Each takes a plane of floats while a frame is rendered."""


def mattes_of(models: JobModels, channels: Collection[str], ids_from: str = "") -> dict[str, Matte]:
    """Mattes among the channels, by name.

    ids_from: property of the model files that holds semantic ids.
    Raises InputError.
    """
    made = {}
    if models.changing and (asked := [name for name in CRYPTOMATTE_CHANNELS if name in channels]):
        raise InputError(
            f"--channels {asked[0]}: {models.path} changes over time, expected models whose Gaussians stay the same"
        )
    if "objects" in channels:
        made["objects"] = _objects(models)
    if "semantic" in channels:
        made["semantic"] = _semantic(models, ids_from)
    for name, matte in made.items():
        if len(matte.names) > MAX_MATTE_OBJECTS:
            raise InputError(
                f"--channels {name}: has {len(matte.names):,} objects, expected at most {MAX_MATTE_OBJECTS}"
            )
    return made


def names_of(mattes: Mapping[str, Matte]) -> tuple[MatteNames, ...]:
    """Names and digests of the mattes, for the options of a job."""
    return tuple(
        MatteNames(name, mattes[name].names, hashlib.sha256(mattes[name].owners.tobytes()).hexdigest()[:32])
        for name in CRYPTOMATTE_CHANNELS
        if name in mattes
    )


def _objects(models: JobModels) -> Matte:
    """A matte with one object for each model, and one for each volume of a model.

    A Gaussian in a volume belongs to the volume and not to the model; in several volumes, to the first.
    """
    names, owners = list(models.names), []
    for index, model in enumerate(models.still):
        own = np.full(len(model), index, np.int32)
        for volume in reversed(models.volumes[index] if models.volumes else ()):  # the first volume wins
            own[volume.holds(model)] = len(names)
            names.append(volume.name)
        owners.append(own)
    return Matte(tuple(names), np.concatenate(owners))


def _semantic(models: JobModels, ids_from: str) -> Matte:
    """A matte with one object for each value of the property."""
    if not models.files:
        raise InputError(f"--ids-from {ids_from}: {models.path} is a USD stage, expected PLY files with the property")
    columns: list[NDArray[np.int64]] = []
    for file, model in zip(models.files, models.still, strict=True):
        with unpacked(file) as (opened, form):
            if form.name != "3DGS PLY":
                found = f"{file} is {form.name}, expected a 3DGS PLY that has the property"
                raise InputError(f"--ids-from {ids_from}: {found}")
            columns.append(read_whole_numbers(opened, ids_from))
        assert len(columns[-1]) == len(model)
    numbers, owners = np.unique(np.concatenate(columns), return_inverse=True)
    return Matte(tuple(str(number) for number in numbers.tolist()), owners.astype(np.int32))
