# SPDX-License-Identifier: Apache-2.0
"""Reading the pages of clsplat.report back in tests."""

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
        """Every element inside with this tag and these attributes, `class_` being a word of the class."""
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
        """Of the data elements inside."""
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
    """The page; every element is closed where it should be."""
    reader = _Reader()
    reader.feed(html)
    reader.close()
    assert len(reader.open) == 1
    return reader.open[0]


def figures_of(page: Element) -> dict[str, Any]:
    """The figures that the page has for programs."""
    found: dict[str, Any] = json.loads(page.one("script", id="figures").text)
    return found


def rows_of(page: Element, table: str) -> list[Element]:
    """The rows of a table's body."""
    return page.one("table", id=table).one("tbody").all("tr")


def charts_of(page: Element) -> dict[str, dict[str, list[tuple[float, float]]]]:
    """By title and series the points (x, y) that the charts are drawn by."""
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
    """Whatever the page would load from elsewhere."""
    found = re.findall(r"""(?:src|href|action|data|poster|srcset)\s*=\s*["']([^"']*)""", html)
    found += re.findall(r"url\(([^)]*)\)|@import\s+(\S+)", html)
    return [each for each in found if not str(each).startswith(("data:image/", "#"))]
