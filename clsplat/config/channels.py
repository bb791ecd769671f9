# SPDX-License-Identifier: Apache-2.0
"""The table of channels: a row says everything about one but the arithmetic of its kernel (docs/channels.md)."""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Kind = Literal["colour", "exact", "whole"]
Source = Literal["image", "features", "depths", "whole", "shares"]


@dataclass(frozen=True)
class Channel:
    """A channel of a frame.

    names: in a file, one for each float. EXR's follow the OpenEXR documentation ("Technical introduction", layers).
    kind: of its values in a file. Colour is half or float as asked for; exact stays float, as a half has 11 bits of a
    depth; whole is uint32 in a part of its own, else float.
    part: its name in a file of several parts.
    source: the kernels' planes that it is taken from. The image is of blend.cl. Features are of features.cl, blended by
    channels.cl. The depths follow them in the same array, and whole numbers are in another. Shares are blended as
    features are, one for each object.
    kernel: its name in the kernels, which get a feature's offset as FEATURE_NAME.
    signs: factors from the kernel's values to the file's, none where they are the same.
    """

    names: tuple[str, ...]
    kind: Kind
    part: str
    source: Source
    kernel: str
    signs: tuple[int, ...] = ()

    @property
    def is_light(self) -> bool:
        """True if samples and filters add it up. Of other channels the frame has those of the middle sample."""
        return self.source in ("image", "shares")


CHANNELS: dict[str, Channel] = {
    "rgb": Channel(("R", "G", "B"), "colour", "rgba", "image", "image"),
    "alpha": Channel(("A",), "colour", "rgba", "image", "transmittance"),
    "depth": Channel(("Z",), "exact", "depth", "features", "depth"),
    "median": Channel(("median.Z",), "exact", "median", "depths", "median"),
    "first": Channel(("first.Z",), "exact", "first", "depths", "first"),
    "normals": Channel(("N.x", "N.y", "N.z"), "colour", "N", "features", "normal"),
    "position": Channel(("P.x", "P.y", "P.z"), "exact", "P", "features", "position"),
    "motion": Channel(("forward.u", "forward.v"), "exact", "forward", "features", "motion", signs=(1, -1)),
    "backward": Channel(("backward.u", "backward.v"), "exact", "backward", "features", "backward", signs=(1, -1)),
    "count": Channel(("count",), "whole", "count", "whole", "count"),
    "id": Channel(("id",), "whole", "id", "whole", "index"),
}
"""Every channel that `--channels` takes, in the order of a file and of the kernels' planes. The v of both motions is
up in files, and docs/channels.md has y down."""

LAYERS = 3
"""Layers of a Cryptomatte, of two objects each."""


def _matte(name: str) -> Channel:
    layers = tuple(f"{name}{layer:02d}.{channel}" for layer in range(LAYERS) for channel in "RGBA")
    return Channel(layers, "exact", name, "shares", name)


MATTES: dict[str, Channel] = {"objects": _matte("cryptoobject"), "semantic": _matte("cryptosemantic")}
"""Cryptomattes, which `--channels` takes too. While a frame is made they have a float for each object."""
WRITTEN = ChainMap(MATTES, CHANNELS)
"""Every channel that a file may have, in their order; CHANNELS come first."""

DEEP = ("R", "G", "B", "A", "Z", "ZBack")
"""Channels of a deep picture."""


def floats_of(source: Source) -> dict[str, int]:
    """The channels of a source by their names in the kernels, in their order, and the floats of each."""
    return {channel.kernel: len(channel.names) for channel in CHANNELS.values() if channel.source == source}


def feature_names(names: Iterable[str]) -> tuple[str, ...]:
    """The kernels' names of those of the channels that are features."""
    asked = set(names)
    return tuple(row.kernel for name, row in CHANNELS.items() if name in asked and row.source == "features")


def light_and_rest(names: Iterable[str]) -> tuple[list[str], list[str]]:
    """The channels that light is added up in, and the others."""
    asked = list(names)
    return [name for name in asked if WRITTEN[name].is_light], [name for name in asked if not WRITTEN[name].is_light]
