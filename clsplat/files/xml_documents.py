# SPDX-License-Identifier: Apache-2.0
"""Reading of XML files that may be hostile: without document types, and bounded in size, depth and number of parts."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from clsplat.errors import InputError
from clsplat.files.documents import open_input

MAX_XML_BYTES = 256 << 20
"""Largest size of an XML file in bytes. A survey of 100,000 photographs takes about 150 MiB."""
MAX_XML_PARTS = 3_000_000
"""Largest number of elements and attributes of an XML file. Each takes up to about 300 bytes of memory."""
MAX_XML_DEPTH = 100
"""Largest depth of nested elements."""


def read_xml(path: Path, expected: str, limit: int = MAX_XML_BYTES) -> Element:
    """Return the root element of an XML file of at most `limit` bytes. Names with a namespace are `{namespace}name`.

    expected: text that follows "expected" in error messages.
    Raises InputError like `open_input`. Also raises it for invalid XML, and for more than `limit`, MAX_XML_PARTS or
    MAX_XML_DEPTH. A document type is refused, because its entities may read other files or grow
    without bound.
    """
    with open_input(path, expected) as file:
        data = file.read(limit + 1)
    if len(data) > limit:
        raise InputError(f"{path}: has more than {limit >> 20} MiB, expected {expected}")
    try:
        return _parsed(data)
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise InputError(f"{path}: is not readable XML: {error}; expected {expected}; export it again") from None


def _parsed(data: bytes) -> Element:
    builder, parser = TreeBuilder(), expat.ParserCreate(namespace_separator="}")
    open_elements = parts = 0

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal open_elements, parts
        open_elements, parts = open_elements + 1, parts + 1 + len(attributes)
        if open_elements > MAX_XML_DEPTH:
            raise ValueError(f"elements are nested more than {MAX_XML_DEPTH} deep")
        if parts > MAX_XML_PARTS:
            raise ValueError(f"it has more than {MAX_XML_PARTS:,} elements and attributes")
        builder.start(_qualified(name), {_qualified(key): value for key, value in attributes.items()})

    def end(name: str) -> None:
        nonlocal open_elements
        open_elements -= 1
        builder.end(_qualified(name))

    def document_type(*_: object) -> None:
        raise ValueError("it has a document type, whose entities are not read")

    parser.buffer_text = True
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = document_type
    parser.Parse(data, True)
    return builder.close()


def _qualified(name: str) -> str:
    return "{" + name if "}" in name else name
