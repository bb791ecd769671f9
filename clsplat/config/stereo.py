# SPDX-License-Identifier: Apache-2.0
"""Settings of stereo pairs (docs/render.md): distance of the eyes, convergence, and the eyes to render."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Literal

from clsplat.errors import InputError

Eye = Literal["left", "right"]
EYES: tuple[Eye, Eye] = ("left", "right")
STEREO_STAGE_WORD = "stage"
"""Value of --stereo that selects the pair of cameras of a USD stage."""


@dataclass(frozen=True)
class StereoConfig:
    """Pairs of pictures, for the left and the right eye."""

    stereo: str = ""  # interaxial distance
    """Distance of the eyes in the scene's units, to render a frame for each eye; or stage, for the two cameras of a USD
    stage with stereoRole left and right. Writes two files if -o has {eye}, %V (left, right) or %v (l, r), else one EXR
    file with a part for each eye. '' renders no pairs."""
    convergence: float | None = None
    """Depth along the camera's axis at which the pictures of both eyes coincide. The principal points are shifted; the
    cameras are not turned. If not given, the eyes look parallel."""
    eye: Literal["both", "left", "right"] = "both"
    """Eyes of --stereo to render. One eye alone is useful for a video, for example."""

    def check(self, *, distort: bool = False) -> None:
        """Raise InputError naming the first setting whose value is invalid.

        distort: True if --distort is given.
        """
        if not self.stereo:
            for flag, given in (("--convergence", self.convergence is not None), ("--eye", self.eye != "both")):
                if given:
                    raise InputError(f"{flag}: applies only to stereo pairs, expected --stereo DISTANCE too")
            return
        if distort:
            raise InputError(
                "--stereo and --distort exclude each other: --distort reproduces a photograph's single camera"
            )
        if self.of_stage:
            if self.convergence is not None:
                raise InputError(
                    "--convergence: the cameras of --stereo stage have their own, expected no --convergence"
                )
            return
        if not 0 < self.distance < inf:
            raise InputError(
                f"--stereo {self.stereo}: expected the distance of the eyes above 0, or {STEREO_STAGE_WORD}"
            )
        if self.convergence is not None and not 0 < self.convergence < inf:
            raise InputError(f"--convergence {self.convergence}: expected a depth above 0")

    @property
    def of_stage(self) -> bool:
        """True if the eyes are cameras of a USD stage."""
        return self.stereo == STEREO_STAGE_WORD

    @property
    def distance(self) -> float:
        """Distance of the eyes in the scene's units; NaN if --stereo is not a number."""
        try:
            return float(self.stereo)
        except ValueError:
            return float("nan")

    @property
    def eyes(self) -> tuple[Eye, ...]:
        """Eyes to render; empty if frames are not stereo pairs."""
        if not self.stereo:
            return ()
        return EYES if self.eye == "both" else (self.eye,)
