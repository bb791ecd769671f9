# SPDX-License-Identifier: Apache-2.0
"""Settings in config.toml: writing, reading and checking, also of files of earlier versions.

Settings that a resume cannot change: `check_resumed` in `runs/run.py`.
"""

from __future__ import annotations

import json
import sys
import warnings
from dataclasses import asdict, fields, is_dataclass
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, get_origin, get_type_hints

import tomli_w

from clsplat.config.checks import misfit
from clsplat.config.rasterizer import BenchSwitches, RasterizerConfig
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError, plain
from clsplat.files.documents import MAX_SETTINGS_BYTES, read_document
from clsplat.version import package_version

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


MAX_METRICS_BYTES, MAX_METRICS_LINE_BYTES = 64 << 20, 1 << 16
"""Size limits in bytes: metrics.jsonl, and one line of metrics.jsonl.

The limit of metrics.jsonl is hundreds of times the output of the longest training.
"""
T = TypeVar("T")
RETIRED_SETTINGS: dict[str, object] = {"train.rasterizer.sh_angle": 0.0} | {
    f"train.rasterizer.{name}": value
    for name, value in vars(BenchSwitches()).items()
    if name not in vars(RasterizerConfig())
}
RETIRED_SETTINGS |= {
    f"train.rasterizer.{name}": True for name in ("vector_skip", "last_contributor", "gradient_skip", "opacity_cull")
}
RETIRED_SETTINGS |= {
    "train.density.edge_views": 0,
    "train.density.prune_at": [],
    "train.density.prune_fraction": 0.0,
    "train.density.views_agree": 1,
    "train.frequency_steps": 0,
}
"""Removed settings of earlier versions, each with the value that switched it off."""
_ADDED_SETTINGS: dict[str, tuple[str, Any]] = {
    "train.test_most": ("test_every", 0),
    "train.photos": ("test_every", "exact"),
}
"""Settings that earlier versions did not have, each with an older setting and a value. A config.toml that has the older
setting but not the new one gets the value for the new one. The value keeps the behaviour of earlier versions."""
_RETIRED_VALUES = {("train.rasterizer.extent", "constant")}
"""Settings and values that only earlier versions allowed. The setting's default replaces such a value."""


def config_text(config: TrainConfig, scene: Path | None) -> str:
    """Return the text of config.toml with these settings. scene: path of the scene, or None to leave it out."""
    document: dict[str, Any] = {"clsplat": package_version()}
    if scene is not None:
        document["scene"] = str(scene)
    document["train"] = table_of(config)
    return tomli_w.dumps(document)


def table_of(config: TrainConfig) -> dict[str, Any]:
    """Return settings as values that TOML and JSON can hold, by name; each group of settings is a table of its own."""
    table: dict[str, Any] = json.loads(json.dumps(asdict(config), default=lambda number: number.item()))  # from NumPy
    return table


def read_config(path: Path) -> tuple[TrainConfig, Path | None]:
    """Read the configuration and the scene's path. Raises InputError, which names the file and the wrong key."""
    return parse_config(read_document(path, "the settings of a run", MAX_SETTINGS_BYTES), path)


def parse_config(text: str, path: Path) -> tuple[TrainConfig, Path | None]:
    """Return settings and scene path from the text of config.toml. Warns of ignored settings of earlier versions.

    path: path of the file, for messages.
    Raises InputError.
    """
    try:
        document = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not readable as TOML ({error})") from None
    for key in document:
        if key not in ("clsplat", "scene", "train"):
            raise InputError(
                f"{path}: has {key!r}, which is not a setting; expected only clsplat, scene and the tables of train"
            )
    scene = document.get("scene")
    if scene is not None and not (isinstance(scene, str) and scene):
        raise InputError(f"{path}: scene is {scene!r}, expected the scene's path as text")
    config = config_of(document.get("train", {}), path)
    return config, Path(scene) if scene is not None else None


def config_of(table: Any, path: Path) -> TrainConfig:
    """Return the settings in a table as from `table_of`. Warns of ignored settings of earlier versions.

    path: path of the file that holds the table, for messages.
    Raises InputError.
    """
    passed_over: list[str] = []
    config = _from_table(TrainConfig, table, path, "train", passed_over)
    if passed_over:
        _warn_once(plain(f"{path}: has settings that this version lacks, which are ignored: {', '.join(passed_over)}"))
    try:
        config.check()
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return config


def _from_table(cls: type[T], table: Any, path: Path, where: str, passed_over: list[str]) -> T:
    """Build the dataclass `cls` from a table of config.toml, whose name is `where`. Missing keys keep their defaults.

    Settings of earlier versions that are ignored, although they had an effect, are added to `passed_over`.
    """
    if not isinstance(table, dict):
        raise InputError(f"{path}: {where} is {table!r}, expected a table")
    types = get_type_hints(cls)
    names = [f.name for f in fields(cls)]  # type: ignore[arg-type]  # every caller passes a dataclass
    added = {key: _ADDED_SETTINGS.get(f"{where}.{key}", ("", None)) for key in names}
    values = {key: value for key, (beside, value) in added.items() if beside in table}
    for key, value in table.items():
        name = f"{where}.{key}"
        if name in RETIRED_SETTINGS or (isinstance(value, str) and (name, value) in _RETIRED_VALUES):
            if value != RETIRED_SETTINGS.get(name):
                passed_over.append(f"{name} = {value!r:.100}")
            continue
        if key not in names:
            raise InputError(f"{path}: [{where}] has {key!r}, which is not a setting there; {_meant(key, where)}")
        if is_dataclass(types[key]):
            values[key] = _from_table(types[key], value, path, name, passed_over)
        else:
            if expected := misfit(types[key], value):
                raise InputError(f"{path}: {name} is {value!r:.100}, expected {expected}")
            kind = get_origin(types[key]) or types[key]
            values[key] = kind(value) if kind in (float, tuple) else value
    return cls(**values)


def _meant(key: str, where: str) -> str:
    """Return a hint for a message: the table that has the setting `key` or one of a similar name.

    where: name of the table that has the unknown `key`.
    """
    tables = {"train": TrainConfig} | {
        f"train.{name}": kind for name, kind in get_type_hints(TrainConfig).items() if is_dataclass(kind)
    }
    places = {f.name: table for table, kind in reversed(tables.items()) for f in fields(kind)}
    if key in places:
        return f"it belongs to [{places[key]}]"
    here = [name for name, table in places.items() if table == where]
    near = get_close_matches(key, here, 1) or get_close_matches(key, places, 1)
    if near:
        return f"did you mean {near[0]!r} in [{places[near[0]]}]?"
    return "remove it; was it written by another version?"


@cache
def _warn_once(text: str) -> None:
    """Warn with the same text only once, however often a file is read."""
    warnings.warn(text)
