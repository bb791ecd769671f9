# SPDX-License-Identifier: Apache-2.0
"""Self-test stages, their error bounds and their results, shared by the parent and the worker process."""

from __future__ import annotations

from dataclasses import dataclass

FORWARD_STAGES = ("arithmetic", "project", "duplicate", "sort", "ranges", "blend")
"""Stages that a frame needs."""
CHANNEL_STAGES = ("features", "channels")
"""Stages that a frame with channels other than colour and alpha needs in addition to FORWARD_STAGES."""
DEEP_STAGES = ("deep", "deep_merge")
"""Stages of a frame in slices by depth, and of a merge of several."""
HOLDOUT_STAGES = ("holdout",)
"""The stage of a frame behind the surfaces of CG elements."""
RAY_STAGES = ("rays",)
"""The stage of a frame of an equirectangular or fisheye camera."""
MASK_STAGES = ("masks",)
"""Stages for training photographs with masks or alpha, in addition to TRAINING_STAGES."""
BACKWARD_STAGES = ("append", "loss", "blend_grad", "project_grad", "penalties", "adam", "noise", "statistics")
"""Stages that training needs in addition to a frame's."""
APPEARANCE_STAGES = ("appearance", "ppisp", "grid")
"""Stages that training with learnt appearance needs, in addition to TRAINING_STAGES."""
DEPTH_STAGES = ("depth",)
"""Stages that training with depth comparison needs."""
POSE_STAGES = ("pose",)
"""Stages that training with pose refinement needs."""
LENS_STAGES = ("lens",)
"""Stages that training with lens refinement needs."""
LIBRARY_STAGES = ("ewa", "harmonics", "splats", "values")
"""Stages of the library's calls, in addition to a frame's."""
TRAINING_STAGES = (*FORWARD_STAGES, *BACKWARD_STAGES)
SELFTEST_STAGES = (
    *(*FORWARD_STAGES, *CHANNEL_STAGES, *DEEP_STAGES, *HOLDOUT_STAGES, *RAY_STAGES, *MASK_STAGES, *BACKWARD_STAGES),
    *(*APPEARANCE_STAGES, *DEPTH_STAGES, *POSE_STAGES, *LENS_STAGES, *LIBRARY_STAGES),
)
INDEX_STAGES = ("project", "duplicate", "sort", "ranges", "append")
"""Stages whose counts and lists index the arrays of later stages."""

STAGE_BOUNDS_ULP: dict[str, tuple[float, str]] = {
    "arithmetic": (3.01, "what OpenCL 1.2 allows a square root, 3 ulp; a division may have 2.5"),
    "project": (256, "30 found, at opacities near 1; six times that for roots and divisions of 3 ulp, not 0.5"),
    "duplicate": (0, "whole numbers"),
    "sort": (0, "whole numbers"),
    "ranges": (0, "whole numbers"),
    "append": (0, "whole numbers"),
    "blend": (256, "11 found; 256 are 1.5e-5 of a colour of 0.5, under the 2e-5 that a frame may be off"),
    "features": (64, "6 found; two divisions and a root one after the other"),
    "channels": (256, "13 found, of normals that cancel; else as blend"),
    "deep": (256, "27 found; as blend"),
    "deep_merge": (256, "4 found; as blend"),
    "holdout": (256, "8 found; as blend"),
    "rays": (512, "47 found; directions and rays have several quotients and roots of 3 ulp, not 0.5"),
    "masks": (128, "as loss"),
    "loss": (128, "9 found; the SSIM's quotients may have six times that"),
    "blend_grad": (1024, "32 found; up to 64 divisions one after the other recover the transmittance"),
    "project_grad": (512, "39 found, at opacities near 1; six times that for sloppy divisions"),
    "penalties": (32, "2 found; an exponential and a product"),
    "adam": (32, "2 found; one root and one division"),
    "noise": (256, "15 found; of 100 (o - dead) a digit of o is 16 ulp, and turned axes cancel"),
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
"""Error bound of each stage in ulp, and the reason for it.

Each bound is the error measured where every operation rounds like IEEE 754, with room for a GPU whose divisions and
roots do not. A wrong operation is off by thousands.
"""


@dataclass(frozen=True)
class Result:
    """The result of a stage over all frozen scenes.

    absolute, ulp: the worst error.
    bound: the error bound in ulp.
    same_bits: True if the bits match the stored digest; None if none is stored for this shape.
    ms: milliseconds of all scenes.
    trouble: a fault other than the error, in words, or empty.
    where: the place of the worst error in ulp.
    otherwise: operations that do not round like IEEE 754.
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
        """True if the stage can be trusted. Different bits alone are no failure."""
        return not self.trouble and self.ulp <= self.bound
