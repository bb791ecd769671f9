# SPDX-License-Identifier: Apache-2.0
"""Settings of stereo pairs (docs/render.md)."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Literal

from clsplat.errors import InputError

Eye = Literal["left", "right"]
EYES: tuple[Eye, Eye] = ("left", "right")
STAGE = "stage"
"""Word for the pair of cameras that a USD stage has."""


@dataclass(frozen=True)
class StereoConfig:
    """Pairs of pictures, for the left and the right eye."""

    stereo: str = ""
    """Render a frame for each eye, this far apart in the scene's units; or stage: from the two cameras of a USD stage
    that have stereoRole left and right. Two files with {eye}, %V (left, right) or %v (l, r) in -o, else one EXR file
    with a part for each eye. '' renders no pairs."""
    convergence: float | None = None
    """Depth at which both eyes see the same, along the camera's axis: their principal points are shifted, they are not
    turned. If not given they look parallel."""
    eye: Literal["both", "left", "right"] = "both"
    """Render one eye of --stereo alone, such as for a video."""

    def check(self, *, distort: bool = False) -> None:
        """Raise InputError naming the first setting whose value makes no sense. distort: pictures are bent as
        photographs are."""
        if not self.stereo:
            for flag, given in (("--convergence", self.convergence is not None), ("--eye", self.eye != "both")):
                if given:
                    raise InputError(f"{flag}: is of stereo pairs, expected --stereo DISTANCE with it")
            return
        if distort:
            raise InputError("--stereo and --distort exclude each other: a photograph was taken by one eye")
        if self.of_stage:
            if self.convergence is not None:
                raise InputError("--convergence: the cameras of --stereo stage have their own, expected it without")
            return
        if not 0 < self.distance < inf:
            raise InputError(f"--stereo {self.stereo}: expected the distance of the eyes above 0, or {STAGE}")
        if self.convergence is not None and not 0 < self.convergence < inf:
            raise InputError(f"--convergence {self.convergence}: expected a depth above 0")

    @property
    def of_stage(self) -> bool:
        """True if the eyes are cameras of a USD stage."""
        return self.stereo == STAGE

    @property
    def distance(self) -> float:
        """Distance of the eyes in the scene's units; NaN for what is no number."""
        try:
            return float(self.stereo)
        except ValueError:
            return float("nan")

    @property
    def eyes(self) -> tuple[Eye, ...]:
        """The eyes that are rendered, none where the frames are no pairs."""
        if not self.stereo:
            return ()
        return EYES if self.eye == "both" else (self.eye,)
