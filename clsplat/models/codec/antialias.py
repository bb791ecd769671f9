# SPDX-License-Identifier: Apache-2.0
"""The words by which programs say that a model is antialiased, trained with Mip-Splatting's low-pass, or is not.

A line of a header counts if it is a key and a value and nothing else, as in Brush's `SplatRenderMode: mip`
(https://github.com/ArthurBrussee/brush), Postshot's `antialiased 1`, gsplat's and nerfstudio's `rasterize_mode
antialiased` and Mip-Splatting's `mip_filter: true`: between them is a colon, an equals sign or blanks; case, quotation
marks, hyphens and underscores make no difference. So does the word alone, and the flag of a command line, which is
`--antialiasing` of the paper's authors. Keys that other things have too, `model` of a scene's name say, count with the
exact words. A sentence that has such a word says nothing, which is told unless it negates the word. Of several the last
counts, as programs that rewrite a file add their line behind those that are there.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

WORDS = {
    **dict.fromkeys(("true", "t", "yes", "y", "on", "enabled"), True),
    **dict.fromkeys(("false", "f", "no", "n", "off", "disabled"), False),
}
MODES = {
    **dict.fromkeys(("antialias", "antialiased", "antialiasing", "aa", "mip", "mipsplat", "mipsplatting"), True),
    **dict.fromkeys(("default", "classic", "standard", "normal", "none", "3dgs", "2dgs"), False),
}
_ALONE = frozenset(("antialias", "antialiased", "antialiasing"))
_FLAGS = frozenset(
    (*_ALONE, "aa", "mip", "mipfilter", "mipsplat", "mipsplatting", "useantialiasing", "useantialiased", "usemip",
     "isantialiased", "ismip", "trainedantialiased", "withantialiasing")
)  # fmt: skip
_MODE_KEYS = frozenset(
    ("splatrendermode", "rasterizemode", "rasterisemode", "rasterizationmode", "rasterizermode", "splatmodel",
     "antialiasmode", "antialiasingmode")
)  # fmt: skip
_GENERAL_KEYS = frozenset(("rendermode", "renderingmode", "model", "trainflags"))
_WORD = r"anti[-_ ]?alias(?:ed|ing)?"
_KEY = rf"[a-z][\w.-]*|{_WORD}|mip splatting"
_VALUE = rf"[\w.+-]+|{_WORD}|mip splatting|mip [\d.]+"
_LINE = re.compile(
    rf"""\s*["']?(?:--)?({_KEY})["']?(?:\s*[:=]\s*|\s+)["']?(?:--)?({_VALUE})["']?[,;]?\s*""", re.IGNORECASE
)
_MIP = re.compile(r"mip[-_ ]?\d+(\.\d+)?")
"""The word with how much of the low-pass: some write mip-0.1."""
_NAMED = re.compile(rf"(?<![a-z0-9]){_WORD}(?![a-z0-9])", re.IGNORECASE)
_FLAG = re.compile(rf"(?:^|\s)--{_WORD}(?=\s+--?[a-z]|\s*$)", re.IGNORECASE)
_NEGATED = re.compile(r"\b(?:not|no|non|never|without)\b|n't\b", re.IGNORECASE)


def _plain(word: str) -> str:
    """A key or a value without what makes no difference."""
    return re.sub(r"[-_ ]", "", word.lower())


def _switch(word: str) -> bool | None:
    """True or False of a word or a number that means it."""
    try:
        return {1.0: True, 0.0: False}.get(float(word))
    except ValueError:
        return WORDS.get(word)


def _meaning(key: str, value: object) -> bool | None:
    """True, False, or None where the key or its value says nothing of antialiasing."""
    key = _plain(key.rpartition(".")[2])  # of pipeline.model.rasterize_mode
    word = str(value).strip().lower()
    mode = MODES.get(_plain(word))
    if key in _GENERAL_KEYS:
        return mode
    mode = True if _MIP.fullmatch(word) else mode
    if key in _MODE_KEYS:
        return mode
    switch = _switch(word)
    return (mode if switch is None else switch) if key in _FLAGS else None


def of_line(line: str) -> bool | None:
    """The meaning of a comment of a header: True, False, or None for nothing."""
    if _plain(line.strip("\"' ")) in _ALONE or (_FLAG.search(line) and not _NEGATED.search(line)):
        return True
    match = _LINE.fullmatch(line)
    return _meaning(*match.groups()) if match else None


class Said:
    """The words of a file in several places. antialiased: what counts, the last; contradiction: a line for a warning,
    without the file's name, empty where all say the same; passed_over: as well, of the first text that has a word of
    antialiasing and says neither, empty where another text counts."""

    def __init__(self, places: Iterable[tuple[str, bool | None]]) -> None:
        places = list(places)
        said = [(text, meaning) for text, meaning in places if meaning is not None]
        self.antialiased = bool(said and said[-1][1])
        other = next((text for text, meaning in reversed(said) if meaning != self.antialiased), None)
        self.contradiction = (
            f"says {other!r} and {said[-1][0]!r}, the last of which counts: the model is "
            f"{'' if self.antialiased else 'not '}antialiased"
            if other is not None
            else ""
        )
        unclear = (text for text, _ in places if _NAMED.search(text) and not _NEGATED.search(text))
        text = None if said else next(unclear, None)
        self.passed_over = (
            f"says {text!r}, which is not understood: the model counts as not antialiased, expected words such as "
            "'antialiased 1'"
            if text is not None
            else ""
        )

    @property
    def warning(self) -> str:
        """The line to warn with, if there is one."""
        return self.contradiction or self.passed_over


def of_comments(comments: Iterable[str]) -> Said:
    """The words of the comments of a header, without the word `comment`."""
    return Said((line[:80], of_line(line)) for line in comments)


def of_object(document: Mapping[str, Any]) -> Said:
    """The words of the keys of a JSON object."""
    pairs = ((key, value) for key, value in document.items() if isinstance(value, str | bool | int | float))
    return Said((f"{key[:40]}: {str(value)[:40]}", _meaning(key, value)) for key, value in pairs)
