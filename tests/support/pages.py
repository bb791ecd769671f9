# SPDX-License-Identifier: Apache-2.0
"""Parsing of the pages of `clsplat.report`, for tests of their contents."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from html.parser import HTMLParser
from typing import Any

VOID = {"meta", "img", "input", "link", "br", "line", "circle", "path"}


@dataclass
class Element:
    tag: str
    attributes: dict[str, str]
    text: str = ""
    inside: list[Element] = field(default_factory=list)

    def all(self, tag: str, **wanted: str) -> list[Element]:
        """All elements inside with this tag and these attributes. class_: one of the words of their class."""
        found = []
        for each in self.inside:
            name = wanted.get("class_")
            others = {key: value for key, value in wanted.items() if key != "class_"}
            has_class = name is None or name in each.attributes.get("class", "").split()
            if each.tag == tag and has_class and others.items() <= each.attributes.items():
                found.append(each)
            found += each.all(tag, **wanted)
        return found

    def one(self, tag: str, **wanted: str) -> Element:
        (found,) = self.all(tag, **wanted)
        return found

    @property
    def words(self) -> str:
        """All text inside."""
        return self.text + "".join(each.words for each in self.inside)

    @property
    def values(self) -> list[str]:
        """Values of the data elements inside."""
        return [each.attributes["value"] for each in self.all("data")]


class _Reader(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.open = [Element("page", {})]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        element = Element(tag, {name: value or "" for name, value in attrs})
        self.open[-1].inside.append(element)
        if tag not in VOID:
            self.open.append(element)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.open[-1].inside.append(Element(tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        assert self.open[-1].tag == tag, f"</{tag}> ends <{self.open[-1].tag}>"
        self.open.pop()

    def handle_data(self, data: str) -> None:
        self.open[-1].text += data


def parse(html: str) -> Element:
    """The page as an element. Fails if an element is not closed, or closed in the wrong place."""
    reader = _Reader()
    reader.feed(html)
    reader.close()
    assert len(reader.open) == 1
    return reader.open[0]


def figures_of(page: Element) -> dict[str, Any]:
    """The numbers that the page holds for programs."""
    found: dict[str, Any] = json.loads(page.one("script", id="figures").text)
    return found


def rows_of(page: Element, table: str) -> list[Element]:
    """The rows of a table's body."""
    return page.one("table", id=table).one("tbody").all("tr")


def charts_of(page: Element) -> dict[str, dict[str, list[tuple[float, float]]]]:
    """Points (x, y) of each series, by the titles of the charts and the names of the series."""
    found = {}
    for figure in page.all("figure", class_="chart"):
        series = {}
        for path in figure.all("path"):
            if "data-values" in path.attributes:
                flat = list(map(float, path.attributes["data-values"].split()))
                series[path.attributes["data-name"]] = list(zip(flat[::2], flat[1::2], strict=True))
        found[figure.one("figcaption").text] = series
    return found


def outside_of(html: str) -> list[str]:
    """Addresses outside the page that it would load or lead to. Empty for a page that needs no other files."""
    found = re.findall(r"""(?:src|href|action|data|poster|srcset)\s*=\s*["']([^"']*)""", html)
    found += re.findall(r"url\(([^)]*)\)|@import\s+(\S+)", html)
    return [each for each in found if not str(each).startswith(("data:image/", "#"))]
