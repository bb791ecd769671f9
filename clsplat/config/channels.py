# SPDX-License-Identifier: Apache-2.0
"""The table of channels. A row describes everything of a channel except its kernel's arithmetic (docs/channels.md)."""

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

    names: names in a file, one for each float. EXR names follow the OpenEXR documentation ("Technical introduction",
    layers).
    kind: type of its values in a file. "colour" is half or float, as requested. "exact" is always float, as a half has
    only 11 bits. "whole" is uint32 if the channel has a part of its own, else float.
    part: its name in a file of several parts.
    source: the device arrays that hold it. "image": from blend.cl. "features": from features.cl, blended by
    channels.cl. "depths": in the same array, after the features. "whole": in another array. "shares": blended like
    features, one for each object.
    kernel: its name in the kernels, which get a feature's offset as FEATURE_NAME.
    signs: factors from the kernel's values to the file's; empty if they are equal.
    """

    names: tuple[str, ...]
    kind: Kind
    part: str
    source: Source
    kernel: str
    signs: tuple[int, ...] = ()

    @property
    def is_light(self) -> bool:
        """True if the values of several samples are summed. Other channels come from a frame's middle sample."""
        return self.source in ("image", "shares")


FRAME_CHANNELS: dict[str, Channel] = {
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
"""Every channel that `--channels` takes, in the order of a file and of the kernels' planes. In files the v of both
motions points up; in docs/channels.md y points down."""

CRYPTOMATTE_LAYERS = 3
"""Layers of a Cryptomatte, with two objects each."""


def _matte(name: str) -> Channel:
    layers = tuple(f"{name}{layer:02d}.{channel}" for layer in range(CRYPTOMATTE_LAYERS) for channel in "RGBA")
    return Channel(layers, "exact", name, "shares", name)


CRYPTOMATTE_CHANNELS: dict[str, Channel] = {"objects": _matte("cryptoobject"), "semantic": _matte("cryptosemantic")}
"""Cryptomattes, which `--channels` takes too. During rendering they have one float for each object."""
WRITABLE_CHANNELS = ChainMap(CRYPTOMATTE_CHANNELS, FRAME_CHANNELS)
"""Every channel that a file may have, in file order: FRAME_CHANNELS come first."""

DEEP_CHANNELS = ("R", "G", "B", "A", "Z", "ZBack")
"""Channels of a deep picture."""


def floats_of(source: Source) -> dict[str, int]:
    """The number of floats of each channel with this source, keyed by kernel name, in the order of the planes."""
    return {channel.kernel: len(channel.names) for channel in FRAME_CHANNELS.values() if channel.source == source}


def feature_names(names: Iterable[str]) -> tuple[str, ...]:
    """Kernel names of the features among these channels."""
    asked = set(names)
    return tuple(row.kernel for name, row in FRAME_CHANNELS.items() if name in asked and row.source == "features")


def light_and_rest(names: Iterable[str]) -> tuple[list[str], list[str]]:
    """The channels that accumulate light, and the others."""
    asked = list(names)
    return [name for name in asked if WRITABLE_CHANNELS[name].is_light], [
        name for name in asked if not WRITABLE_CHANNELS[name].is_light
    ]
