# SPDX-License-Identifier: Apache-2.0
"""Provenance record of a frame as text, for files whose headers have no custom attributes."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

MODEL_DIGEST_ATTRIBUTE, SETTINGS_DIGEST_ATTRIBUTE = "clsplat:model", "clsplat:settings"
"""Attributes that record a frame's source: SHA-256 of the model file, and a digest of all other settings."""
RECORD_TAGS = {
    **dict.fromkeys((".tif", ".tiff", ".jpg", ".jpeg"), "ImageDescription"),
    ".dpx": "DocumentName",
}
"""Header text that holds the record. In a DPX it is the project name, which has 200 characters."""
_RECORD_PATTERN = re.compile(r"clsplat model ([0-9a-z]+) settings ([0-9a-z]+)", re.ASCII)


def record_text(attributes: Mapping[str, Any]) -> str:
    """Record of a header's attributes; '' if they have none."""
    model, settings = attributes.get(MODEL_DIGEST_ATTRIBUTE), attributes.get(SETTINGS_DIGEST_ATTRIBUTE)
    return f"clsplat model {model} settings {settings}" if model and settings else ""


def parse_record(text: object) -> dict[str, str]:
    """Attributes in a record; empty for any other text."""
    match = _RECORD_PATTERN.search(str(text or ""))
    return {MODEL_DIGEST_ATTRIBUTE: match[1], SETTINGS_DIGEST_ATTRIBUTE: match[2]} if match else {}


def attribute_of(spec: Any, name: str) -> Any:
    """Attribute in OpenImageIO's specification of a file, or in the record there; None if neither has it."""
    value = spec.getattribute(name)
    for place in dict.fromkeys(RECORD_TAGS.values()) if value is None else ():
        value = parse_record(spec.getattribute(place)).get(name) if value is None else value
    return value
