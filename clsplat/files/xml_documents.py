# SPDX-License-Identifier: Apache-2.0
"""Reading of XML files that may be hostile: without document types, and bounded in size, elements and depth."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from clsplat.errors import InputError
from clsplat.files.documents import open_input

MAX_XML_BYTES = 256 << 20
"""Largest size of an XML file in bytes. A survey of 100,000 photographs takes about 150 MiB."""
MAX_XML_ELEMENTS = 3_000_000
"""Largest number of elements of an XML file. Each takes about 300 bytes of memory."""
MAX_XML_DEPTH = 100
"""Largest depth of nested elements."""


def read_xml(path: Path, expected: str) -> Element:
    """Return the root element of an XML file. Names with a namespace are `{namespace}name`.

    expected: text that follows "expected" in error messages.
    Raises InputError like `open_input`. Also raises it for invalid XML, and for more than MAX_XML_BYTES,
    MAX_XML_ELEMENTS or MAX_XML_DEPTH. A document type is refused, because its entities may read other files or grow
    without bound.
    """
    with open_input(path, expected) as file:
        data = file.read(MAX_XML_BYTES + 1)
    if len(data) > MAX_XML_BYTES:
        raise InputError(f"{path}: has more than {MAX_XML_BYTES >> 20} MiB, expected {expected}")
    try:
        return _parsed(data)
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise InputError(f"{path}: is not readable XML: {error}; expected {expected}; export it again") from None


def _parsed(data: bytes) -> Element:
    builder, parser = TreeBuilder(), expat.ParserCreate(namespace_separator="}")
    open_elements = elements = 0

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal open_elements, elements
        open_elements, elements = open_elements + 1, elements + 1
        if open_elements > MAX_XML_DEPTH:
            raise ValueError(f"elements are nested more than {MAX_XML_DEPTH} deep")
        if elements > MAX_XML_ELEMENTS:
            raise ValueError(f"it has more than {MAX_XML_ELEMENTS:,} elements")
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
