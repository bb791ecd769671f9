# SPDX-License-Identifier: Apache-2.0
"""The stages of the self-test, how far each may be off, and what it says of one: what the parent needs of the child."""

from __future__ import annotations

from dataclasses import dataclass

FORWARD = ("arithmetic", "project", "duplicate", "sort", "ranges", "blend")
"""Stages that a frame needs."""
CHANNELS = ("features", "channels")
"""Stages that a frame with more than colour and alpha needs beside FORWARD."""
DEEP = ("deep",)
"""A frame in slices by depth."""
HOLDOUT = ("holdout",)
"""A frame behind the surfaces of other elements."""
RAYS = ("rays",)
"""A frame of an equirectangular or a fisheye camera."""
MASKS = ("masks",)
"""Stages that photographs with masks or alpha to learn need beside TRAINING."""
BACKWARD = ("loss", "blend_grad", "project_grad", "adam", "statistics")
"""Stages that training needs beside a frame's."""
APPEARANCE: dict[str, tuple[str, ...]] = {
    "none": (),
    "exposure": ("appearance",),
    "ppisp": ("appearance", "ppisp"),
    "grid": ("grid",),
}
"""Stages of what is learnt of each photograph, which training needs beside TRAINING, by the setting."""
DEPTH = ("depth",)
"""Stages of known depths, which training needs where they are compared."""
POSES = ("pose",)
"""Stages of poses, which training needs where they are refined."""
LENSES = ("lens",)
"""The same of lenses."""
LIBRARY = ("ewa", "harmonics", "splats", "values")
"""Stages of the library's calls, beside a frame's."""
TRAINING = (*FORWARD, *BACKWARD)
STAGES = (
    *(*FORWARD, *CHANNELS, *DEEP, *HOLDOUT, *RAYS, *MASKS, *BACKWARD),
    *("appearance", "ppisp", "grid", *DEPTH, *POSES, *LENSES, *LIBRARY),
)
INDICES = ("project", "duplicate", "sort", "ranges")
"""Stages by whose counts and lists the next ones find their way."""

BOUNDS: dict[str, tuple[float, str]] = {
    "arithmetic": (3.01, "what OpenCL 1.2 allows a square root, 3 ulp; a division may have 2.5"),
    "project": (256, "30 found, at opacities near 1; six times that for roots and divisions of 3 ulp, not 0.5"),
    "duplicate": (0, "whole numbers"),
    "sort": (0, "whole numbers"),
    "ranges": (0, "whole numbers"),
    "blend": (256, "11 found; 256 are 1.5e-5 of a colour of 0.5, under the 2e-5 that a frame may be off"),
    "features": (64, "6 found; two divisions and a root one after the other"),
    "channels": (256, "13 found, of normals that cancel; else as blend"),
    "deep": (256, "27 found; as blend"),
    "holdout": (256, "8 found; as blend"),
    "rays": (512, "47 found; directions and rays have several quotients and roots of 3 ulp, not 0.5"),
    "masks": (128, "as loss"),
    "loss": (128, "9 found; the SSIM's quotients may have six times that"),
    "blend_grad": (1024, "32 found; up to 64 divisions one after the other recover the transmittance"),
    "project_grad": (512, "39 found, at opacities near 1; six times that for sloppy divisions"),
    "adam": (32, "2 found; one root and one division"),
    "statistics": (32, "1 found; one root"),
    "appearance": (1024, "202 found; beta2 in float32 is 1e-5 off in 1 - beta2, 84 ulp, and a picture is added up"),
    "ppisp": (1024, "as appearance"),
    "grid": (1024, "227 found; as appearance"),
    "depth": (1024, "as blend_grad"),
    "pose": (1024, "as appearance; terms of either sign are added up"),
    "lens": (1024, "19 found; as pose"),
    "ewa": (1024, "95 found, by quaternions, whose terms cancel; quotients and roots as in project_grad"),
    "harmonics": (64, "10 found; one root and one division"),
    "splats": (64, "2 found; a root and two quotients"),
    "values": (1024, "71 found; as blend_grad"),
}
"""Ulp that a stage may be off, and why. Each bound is the error found where every operation is rounded as in IEEE 754,
with room for a GPU whose divisions and roots are not. A wrong operation is off by thousands."""


@dataclass(frozen=True)
class Result:
    """The result of a stage over all frozen scenes: the worst error, absolute and in ulp; the bound in ulp; same_bits:
    True if the bits are those of the stored digest (None: none is stored for this shape); ms of all scenes; trouble: in
    words what is wrong beside the error, or empty.

    where: the place of the worst error in ulp; otherwise: operations that round in another way than IEEE 754's.
    """

    stage: str
    absolute: float
    ulp: float
    bound: float
    same_bits: bool | None
    ms: float
    trouble: str
    where: str
    otherwise: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """True if the stage can be trusted. Other bits alone do not condemn it."""
        return not self.trouble and self.ulp <= self.bound
