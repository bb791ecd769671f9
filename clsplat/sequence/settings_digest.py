# SPDX-License-Identifier: Apache-2.0
"""A digest of all that a frame's pixels and header depend on beside the model: what `--skip-existing` goes by."""

from __future__ import annotations

import hashlib
import json
from dataclasses import MISSING, fields, is_dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from clsplat.config.pictures import Encoding

SETTINGS = "clsplat:settings"
"""The attribute of EXR and PNG files that holds it."""
_ENCODED = {".exr": ("depth", "parts", "compression"), ".png": ("bits",)}
"""Settings of the encoding that a file of that extension depends on."""


def plain(value: Any) -> Any:
    """A value in the form of JSON. A dataclass becomes its differences from the defaults, so that a setting that is
    added later changes nothing. Floats have 12 digits, as processors differ in the last ones."""
    if is_dataclass(value) and not isinstance(value, type):
        changes = {}
        for setting in fields(value):
            given = getattr(value, setting.name)
            usual = setting.default_factory() if setting.default_factory is not MISSING else setting.default
            if isinstance(given, np.ndarray) or usual is MISSING or given != usual:
                changes[setting.name] = plain(given)
        return changes
    if isinstance(value, float | np.floating):
        return f"{value + 0.0:.12g}"  # + 0.0: no -0
    if isinstance(value, np.ndarray):
        return [plain(float(item)) for item in value.ravel()]
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    return value


def encoding_of(encoding: Encoding, extension: str) -> dict[str, Any]:
    """The settings that a file of that extension depends on."""
    return {name: getattr(encoding, name) for name in _ENCODED.get(extension, ())}


def digest_of(*parts: Any) -> str:
    """128 bits of SHA-256, in hexadecimal, of values that `plain` takes."""
    return hashlib.sha256(json.dumps(plain(parts), sort_keys=True).encode()).hexdigest()[:32]
