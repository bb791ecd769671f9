# SPDX-License-Identifier: Apache-2.0
"""Recognition of antialiased models, trained with Mip-Splatting's low-pass filter, by words in file headers.

A header line states whether a model is antialiased if it has only a key and a value:

- `SplatRenderMode: mip` of Brush (https://github.com/ArthurBrussee/brush).
- `antialiased 1` of Postshot.
- `rasterize_mode antialiased` of gsplat and nerfstudio.
- `mip_filter: true` of Mip-Splatting.

A colon, an equals sign or blanks separate key and value. Case, quotation marks, hyphens and underscores are ignored.
The word `antialiased` alone is such a statement too, and so is a command-line flag such as `--antialiasing` of the 3DGS
authors' program. A line with an ambiguous key, such as `model`, which may hold the name of a scene, is a statement only
if its value is a mode word. A sentence that mentions antialiasing is not used; a warning reports it unless it has a
negation. Of several statements the last is used, since programs that rewrite a file append their own.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

SWITCH_WORDS = {
    **dict.fromkeys(("true", "t", "yes", "y", "on", "enabled"), True),
    **dict.fromkeys(("false", "f", "no", "n", "off", "disabled"), False),
}
ANTIALIAS_MODE_WORDS = {
    **dict.fromkeys(("antialias", "antialiased", "antialiasing", "aa", "mip", "mipsplat", "mipsplatting"), True),
    **dict.fromkeys(("default", "classic", "standard", "normal", "none", "3dgs", "2dgs"), False),
}
_STANDALONE_WORDS = frozenset(("antialias", "antialiased", "antialiasing"))
_SWITCH_KEYS = frozenset(
    (*_STANDALONE_WORDS, "aa", "mip", "mipfilter", "mipsplat", "mipsplatting", "useantialiasing", "useantialiased",
     "usemip", "isantialiased", "ismip", "trainedantialiased", "withantialiasing")
)  # fmt: skip
_MODE_KEYS = frozenset(
    ("splatrendermode", "rasterizemode", "rasterisemode", "rasterizationmode", "rasterizermode", "splatmodel",
     "antialiasmode", "antialiasingmode")
)  # fmt: skip
_AMBIGUOUS_KEYS = frozenset(("rendermode", "renderingmode", "model", "trainflags"))
_ANTIALIAS_PATTERN = r"anti[-_ ]?alias(?:ed|ing)?"
_KEY_PATTERN = rf"[a-z][\w.-]*|{_ANTIALIAS_PATTERN}|mip splatting"
_VALUE_PATTERN = rf"[\w.+-]+|{_ANTIALIAS_PATTERN}|mip splatting|mip [\d.]+"
_KEY_VALUE_LINE = re.compile(
    rf"""\s*["']?(?:--)?({_KEY_PATTERN})["']?(?:\s*[:=]\s*|\s+)["']?(?:--)?({_VALUE_PATTERN})["']?[,;]?\s*""",
    re.IGNORECASE,
)
_MIP_VALUE = re.compile(r"mip[-_ ]?\d+(\.\d+)?")
"""`mip` and the strength of the low-pass filter, such as mip-0.1."""
_MENTIONS_ANTIALIASING = re.compile(rf"(?<![a-z0-9]){_ANTIALIAS_PATTERN}(?![a-z0-9])", re.IGNORECASE)
_COMMAND_LINE_FLAG = re.compile(rf"(?:^|\s)--{_ANTIALIAS_PATTERN}(?=\s+--?[a-z]|\s*$)", re.IGNORECASE)
_NEGATION = re.compile(r"\b(?:not|no|non|never|without)\b|n't\b", re.IGNORECASE)


def _plain(word: str) -> str:
    """A key or value in lower case, without hyphens, underscores and blanks."""
    return re.sub(r"[-_ ]", "", word.lower())


def _switch(word: str) -> bool | None:
    """Return the Boolean that a word such as "on", or the number 0 or 1, stands for; None for any other word."""
    try:
        return {1.0: True, 0.0: False}.get(float(word))
    except ValueError:
        return SWITCH_WORDS.get(word)


def _meaning(key: str, value: object) -> bool | None:
    """True if a header's key and value say that the model is antialiased, False if they deny it, else None."""
    key = _plain(key.rpartition(".")[2])  # a key may name its sections first: pipeline.model.rasterize_mode
    word = str(value).strip().lower()
    mode = ANTIALIAS_MODE_WORDS.get(_plain(word))
    if key in _AMBIGUOUS_KEYS:
        return mode
    mode = True if _MIP_VALUE.fullmatch(word) else mode
    if key in _MODE_KEYS:
        return mode
    switch = _switch(word)
    return (mode if switch is None else switch) if key in _SWITCH_KEYS else None


def of_line(line: str) -> bool | None:
    """True if a header comment says that the model is antialiased, False if it denies it, else None."""
    if _plain(line.strip("\"' ")) in _STANDALONE_WORDS or (
        _COMMAND_LINE_FLAG.search(line) and not _NEGATION.search(line)
    ):
        return True
    match = _KEY_VALUE_LINE.fullmatch(line)
    return _meaning(*match.groups()) if match else None


class AntialiasStatements:
    """Statements about antialiasing in a file's header.

    places: pairs of a text in the header and its meaning: True if it says that the model is antialiased, False if it
        denies it, None if it says neither.
    antialiased: True if the last statement says that the model is antialiased; False without statements.
    contradiction: warning, without the file's name, about statements that disagree; "" if all agree.
    not_understood: warning about the first text that mentions antialiasing but states nothing; "" if any text is a
        statement.
    """

    def __init__(self, places: Iterable[tuple[str, bool | None]]) -> None:
        places = list(places)
        said = [(text, meaning) for text, meaning in places if meaning is not None]
        self.antialiased = bool(said and said[-1][1])
        other = next((text for text, meaning in reversed(said) if meaning != self.antialiased), None)
        self.contradiction = (
            f"says {other!r} and {said[-1][0]!r}, the last of which is used: the model is "
            f"{'' if self.antialiased else 'not '}antialiased"
            if other is not None
            else ""
        )
        unclear = (text for text, _ in places if _MENTIONS_ANTIALIASING.search(text) and not _NEGATION.search(text))
        text = None if said else next(unclear, None)
        self.not_understood = (
            f"says {text!r}, which is not understood: the model is read as not antialiased, expected words such as "
            "'antialiased 1'"
            if text is not None
            else ""
        )

    @property
    def warning(self) -> str:
        """`contradiction`, or else `not_understood`; "" if both are empty."""
        return self.contradiction or self.not_understood


def of_comments(comments: Iterable[str]) -> AntialiasStatements:
    """Statements about antialiasing in a header's comments, which are given without the word `comment`."""
    return AntialiasStatements((line[:80], of_line(line)) for line in comments)


def of_object(document: Mapping[str, Any]) -> AntialiasStatements:
    """Statements about antialiasing in the keys and values of a JSON object."""
    pairs = ((key, value) for key, value in document.items() if isinstance(value, str | bool | int | float))
    return AntialiasStatements((f"{key[:40]}: {str(value)[:40]}", _meaning(key, value)) for key, value in pairs)
