# SPDX-License-Identifier: Apache-2.0
"""The record of what a frame was made of, as text, for files whose headers have no attributes of one's own."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

MODEL, SETTINGS = "clsplat:model", "clsplat:settings"
"""Attributes that say what a frame was made of: SHA-256 of the model file, and a digest of all else."""
PLACES = {
    **dict.fromkeys((".tif", ".tiff", ".jpg", ".jpeg"), "ImageDescription"),
    ".dpx": "DocumentName",
}
"""The header's text that holds the record. Of a DPX it is the project's name, which has 200 characters."""
_TEXT = re.compile(r"clsplat model ([0-9a-z]+) settings ([0-9a-z]+)", re.ASCII)


def record_text(attributes: Mapping[str, Any]) -> str:
    """The record of a header's attributes; '' where it has none."""
    model, settings = attributes.get(MODEL), attributes.get(SETTINGS)
    return f"clsplat model {model} settings {settings}" if model and settings else ""


def parse_record(text: object) -> dict[str, str]:
    """The attributes in a record, none for any other text."""
    match = _TEXT.search(str(text or ""))
    return {MODEL: match[1], SETTINGS: match[2]} if match else {}


def attribute_of(spec: Any, name: str) -> Any:
    """An attribute of OpenImageIO's specification of a file, or of the record that it has; None for neither."""
    value = spec.getattribute(name)
    for place in dict.fromkeys(PLACES.values()) if value is None else ():
        value = parse_record(spec.getattribute(place)).get(name) if value is None else value
    return value
