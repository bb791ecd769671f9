# SPDX-License-Identifier: Apache-2.0
"""Table of a frame's channels (rgb, alpha, depth, normals and so on): names and types in files, and their kernels.

docs/channels.md defines the values.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Literal

Kind = Literal["colour", "exact", "whole"]
Source = Literal["image", "features", "depths", "whole", "shares"]


@dataclass(frozen=True)
class Channel:
    """A channel of a frame.

    names: names in a file, one for each float. EXR names follow the OpenEXR documentation ("Technical introduction",
    layers).
    kind: type of the values in a file. "colour" is half or float, as requested. "exact" is always float, as a half has
    only 11 bits. "whole" is uint32 if the channel has an EXR part of its own, else float.
    part: name of the channel's part in a multi-part EXR file.
    source: origin of the values. "image": blend.cl computes them. "features": features.cl computes them for each
    Gaussian, and channels.cl blends them. "depths": channels.cl writes them to the planes that follow the
    features' planes. "whole": channels.cl writes them to an array of integers. "shares": the coverages of a
    Cryptomatte's objects, which are blended like features.
    kernel: the channel's name in the kernels. The name "depth", for example, is in the macro FEATURE_DEPTH, the offset
    of this feature in a Gaussian's row of features.
    signs: factors from the kernel's values to the file's, one for each float; empty if all are 1.
    note: explanation for --help. Consecutive channels with the same note are listed together.
    """

    names: tuple[str, ...]
    kind: Kind
    part: str
    source: Source
    kernel: str
    signs: tuple[int, ...] = ()
    note: str = ""

    @property
    def is_light(self) -> bool:
        """True if motion blur and depth of field average the channel. Others come from a frame's middle sample."""
        return self.source in ("image", "shares")


FRAME_CHANNELS: dict[str, Channel] = {
    "rgb": Channel(("R", "G", "B"), "colour", "rgba", "image", "image"),
    "alpha": Channel(("A",), "colour", "rgba", "image", "transmittance"),
    "depth": Channel(("Z",), "exact", "depth", "features", "depth", note="depths"),
    "median": Channel(("median.Z",), "exact", "median", "depths", "median", note="depths"),
    "first": Channel(("first.Z",), "exact", "first", "depths", "first", note="depths"),
    "normals": Channel(("N.x", "N.y", "N.z"), "colour", "N", "features", "normal"),
    "position": Channel(("P.x", "P.y", "P.z"), "exact", "P", "features", "position"),
    "motion": Channel(
        ("forward.u", "forward.v"), "exact", "forward", "features", "motion", (1, -1), "to the next frame"
    ),
    "backward": Channel(
        ("backward.u", "backward.v"), "exact", "backward", "features", "backward", (1, -1), "to the previous frame"
    ),
    "count": Channel(("count",), "whole", "count", "whole", "count", note="of Gaussians"),
    "id": Channel(("id",), "whole", "id", "whole", "index", note="of Gaussians"),
}
"""Channels of `--channels` except Cryptomattes, in the order of a file and of the kernels' planes. In files, the
second component (v) of the channels motion and backward points up; in the kernels it points down."""

CRYPTOMATTE_LAYERS = 3
"""Number of layers of a Cryptomatte. Each layer stores the ids and coverages of two objects."""


def _matte(name: str) -> Channel:
    layers = tuple(f"{name}{layer:02d}.{channel}" for layer in range(CRYPTOMATTE_LAYERS) for channel in "RGBA")
    return Channel(layers, "exact", name, "shares", name, note="Cryptomattes")


CRYPTOMATTE_CHANNELS: dict[str, Channel] = {"objects": _matte("cryptoobject"), "semantic": _matte("cryptosemantic")}
"""Cryptomatte channels, by their name in `--channels`. While rendering, each has a plane of coverages per object."""
WRITABLE_CHANNELS = ChainMap(CRYPTOMATTE_CHANNELS, FRAME_CHANNELS)
"""Every channel that a file may have, in file order: FRAME_CHANNELS come first."""

DEEP_CHANNELS = ("R", "G", "B", "A", "Z", "ZBack")
"""EXR channels of a deep picture, in the order of the file."""


def in_words(*sources: Source) -> str:
    """Return the names and notes of all channels with these values of `Channel.source`, as English text for --help."""
    rows = [(name, row.note) for name, row in WRITABLE_CHANNELS.items() if row.source in sources]
    groups = [[*group] for _, group in groupby(rows, lambda row: row[1] or row[0])]
    return _and([_and([name for name, _ in group]) + (f" ({group[0][1]})" if group[0][1] else "") for group in groups])


def _and(words: Sequence[str]) -> str:
    return " and ".join(part for part in (", ".join(words[:-1]), words[-1]) if part)


def floats_of(source: Source) -> dict[str, int]:
    """Return the number of floats of each channel with this `Channel.source`, by the channel's name in the kernels.

    The order is that of the channels' planes on the device.
    """
    return {channel.kernel: len(channel.names) for channel in FRAME_CHANNELS.values() if channel.source == source}


def feature_names(names: Iterable[str]) -> tuple[str, ...]:
    """Return the kernels' names of the channels among `names` whose `Channel.source` is "features".

    The order is that of the channels' planes on the device.
    """
    asked = set(names)
    return tuple(row.kernel for name, row in FRAME_CHANNELS.items() if name in asked and row.source == "features")


def light_and_rest(names: Iterable[str]) -> tuple[list[str], list[str]]:
    """Split channel names in two lists: those averaged over a frame's samples (`Channel.is_light`), and the others."""
    asked = list(names)
    return [name for name in asked if WRITABLE_CHANNELS[name].is_light], [
        name for name in asked if not WRITABLE_CHANNELS[name].is_light
    ]
