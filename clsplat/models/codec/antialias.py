# SPDX-License-Identifier: Apache-2.0
"""The words by which programs say that a model is antialiased, trained with Mip-Splatting's low-pass, or is not.

A line of a header counts if it is a key and a value and nothing else, as in Brush's `SplatRenderMode: mip`
(https://github.com/ArthurBrussee/brush), Postshot's `antialiased 1`, gsplat's and nerfstudio's `rasterize_mode
antialiased` and Mip-Splatting's `mip_filter: true`: between them is a colon, an equals sign or blanks; case, quotation
marks, hyphens and underscores make no difference. A sentence that has such a word says nothing. Of several the last
counts, as programs that rewrite a file add their line behind those that are there.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

WORDS = {"1": True, "true": True, "yes": True, "on": True, "0": False, "false": False, "no": False, "off": False}
MODES = {
    **dict.fromkeys(("antialias", "antialiased", "antialiasing", "aa"), True),
    **dict.fromkeys(("default", "classic", "standard", "normal", "none", "3dgs", "2dgs"), False),
}
_FLAGS = frozenset(
    ("antialias", "antialiased", "antialiasing", "mip", "mipfilter", "mipsplat", "mipsplatting", "useantialiasing",
     "useantialiased", "usemip", "isantialiased", "ismip", "trainedantialiased")
)  # fmt: skip
_MODE_KEYS = frozenset(
    ("splatrendermode", "rendermode", "renderingmode", "rasterizemode", "rasterisemode", "rasterizationmode",
     "rasterizermode", "splatmodel", "model")
)  # fmt: skip
_KEY, _VALUE = r"[A-Za-z][\w.-]*|anti aliased", r"[\w.-]+|mip splatting|anti aliased"
_LINE = re.compile(rf"""\s*["']?(?:--)?({_KEY})["']?\s*(?:[:=]\s*|\s)["']?({_VALUE})["']?[,;]?\s*""")


def _plain(word: str) -> str:
    """A key or a value without what makes no difference."""
    return re.sub(r"[-_ ]", "", word.lower())


def _meaning(key: str, value: object) -> bool | None:
    """True, False, or None where the key or its value says nothing of antialiasing."""
    key = _plain(key.rpartition(".")[2])  # of pipeline.model.rasterize_mode
    if isinstance(value, bool | int | float):
        value = str(int(value)) if value in (0, 1) else ""
    word = str(value).strip().lower()
    mode = True if word.startswith("mip") else MODES.get(_plain(word))  # mip-0.1: some add the low-pass
    if key in _MODE_KEYS:
        return mode
    return WORDS.get(word, mode) if key in _FLAGS else None


def of_line(line: str) -> bool | None:
    """The meaning of a comment of a header: True, False, or None for nothing."""
    match = _LINE.fullmatch(line)
    return _meaning(*match.groups()) if match else None


class Said:
    """The words of a file in several places. antialiased: what counts, the last; contradiction: a line for a warning,
    without the file's name, empty where all say the same."""

    def __init__(self, places: Iterable[tuple[str, bool | None]]) -> None:
        said = [(text, meaning) for text, meaning in places if meaning is not None]
        self.antialiased = bool(said and said[-1][1])
        other = next((text for text, meaning in reversed(said) if meaning != self.antialiased), None)
        self.contradiction = (
            f"says {other!r} and {said[-1][0]!r}, the last of which counts: the model is "
            f"{'' if self.antialiased else 'not '}antialiased"
            if other is not None
            else ""
        )


def of_comments(comments: Iterable[str]) -> Said:
    """The words of the comments of a header, without the word `comment`."""
    return Said((line[:80], of_line(line)) for line in comments)


def of_object(document: Mapping[str, Any]) -> Said:
    """The words of the keys of a JSON object."""
    pairs = ((key, value) for key, value in document.items() if isinstance(value, str | bool | int | float))
    return Said((f"{key[:40]}: {str(value)[:40]}", _meaning(key, value)) for key, value in pairs)
