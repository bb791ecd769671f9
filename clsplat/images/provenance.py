# SPDX-License-Identifier: Apache-2.0
"""Provenance record of a frame: digests of its model and settings, as text if the header has no custom attributes."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

MODEL_DIGEST_ATTRIBUTE, SETTINGS_DIGEST_ATTRIBUTE = "clsplat:model", "clsplat:settings"
"""Header attributes that record a frame's origin: SHA-256 of the model file, and a digest of all other settings."""
RECORD_TAGS = {
    **dict.fromkeys((".tif", ".tiff", ".jpg", ".jpeg"), "ImageDescription"),
    ".dpx": "DocumentName",
}
"""Name of the header text that holds the record, by extension. In a DPX it is the project name, of 200 characters."""
_RECORD_PATTERN = re.compile(r"clsplat model ([0-9a-z]+) settings ([0-9a-z]+)", re.ASCII)


def record_text(attributes: Mapping[str, Any]) -> str:
    """Record as text, from a header's attributes; '' if they have no record."""
    model, settings = attributes.get(MODEL_DIGEST_ATTRIBUTE), attributes.get(SETTINGS_DIGEST_ATTRIBUTE)
    return f"clsplat model {model} settings {settings}" if model and settings else ""


def parse_record(text: object) -> dict[str, str]:
    """Header attributes from the text of a record; empty for any other text."""
    match = _RECORD_PATTERN.search(str(text or ""))
    return {MODEL_DIGEST_ATTRIBUTE: match[1], SETTINGS_DIGEST_ATTRIBUTE: match[2]} if match else {}


def attribute_of(spec: Any, name: str) -> Any:
    """Attribute `name` of a file, from its OpenImageIO specification or its record; None if neither has it."""
    value = spec.getattribute(name)
    for place in dict.fromkeys(RECORD_TAGS.values()) if value is None else ():
        value = parse_record(spec.getattribute(place)).get(name) if value is None else value
    return value
