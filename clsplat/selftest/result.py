# SPDX-License-Identifier: Apache-2.0
"""Stages of the self-test, their error bounds and their results, shared by the parent and the worker process."""

from __future__ import annotations

from dataclasses import dataclass

from clsplat.config.colour_models import COLOUR_MODELS
from clsplat.config.masks import NO_MASKS
from clsplat.config.training import TrainConfig

FORWARD_STAGES = ("arithmetic", "project", "duplicate", "sort", "ranges", "blend")
"""Stages that render a frame."""
CHANNEL_STAGES = ("features", "channels")
"""Further stages for a frame with channels other than colour and alpha."""
DEEP_STAGES = ("deep", "deep_merge")
"""Further stages for deep pictures, and for merging several deep pictures."""
HOLDOUT_STAGES = ("holdout",)
"""Further stage for a frame with holdout surfaces."""
RAY_STAGES = ("rays",)
"""Further stage for cameras that evaluate Gaussians along rays, such as equirectangular and fisheye cameras."""
MASK_STAGES = ("masks",)
"""Further stages for training with masks or alpha."""
BACKWARD_STAGES = ("append", "loss", "blend_grad", "project_grad", "penalties", "adam", "noise", "statistics")
"""Stages that training needs in addition to FORWARD_STAGES."""
APPEARANCE_STAGES = (*COLOUR_MODELS, "grid")
"""Further stages for training with an appearance model, named after the values of the setting `appearance`."""
DEPTH_STAGES = ("depth",)
"""Further stages for training with known depths."""
POSE_STAGES = ("pose",)
"""Further stages for training with pose refinement."""
LENS_STAGES = ("lens",)
"""Further stages for training with lens refinement."""
CHUNK_STAGES = ("bounds", "chunks", "catch_up", "chunk_records")
"""Further stages for training of models of several chunks."""
REGION_STAGES = ("region",)
"""Further stage for training of the Gaussians in a region (`clsplat.training.start.Start`)."""
LIBRARY_STAGES = ("ewa", "harmonics", "splats", "values")
"""Further stages for the functions of `clsplat.library`."""
TRAINING_STAGES = (*FORWARD_STAGES, *BACKWARD_STAGES)
SELFTEST_STAGES = (
    *(*FORWARD_STAGES, *CHANNEL_STAGES, *DEEP_STAGES, *HOLDOUT_STAGES, *RAY_STAGES, *MASK_STAGES, *BACKWARD_STAGES),
    *(*APPEARANCE_STAGES, *DEPTH_STAGES, *POSE_STAGES, *LENS_STAGES, *CHUNK_STAGES, *REGION_STAGES, *LIBRARY_STAGES),
)
INDEX_STAGES = ("project", "duplicate", "sort", "ranges", "append")
"""Stages whose results are indices into the arrays of later stages."""

STAGE_BOUNDS_ULP: dict[str, tuple[float, str]] = {
    "arithmetic": (3.01, "OpenCL 1.2 allows 3 ulp for a square root and 2.5 for a division"),
    "project": (256, "30 measured, at opacities near 1; six times as much if roots and divisions are off by 3 ulp"),
    "duplicate": (0, "whole numbers"),
    "sort": (0, "whole numbers"),
    "ranges": (0, "whole numbers"),
    "append": (0, "whole numbers"),
    "blend": (256, "11 measured; 256 ulp of a colour of 0.5 are 1.5e-5, and a frame may be off by 2e-5"),
    "features": (64, "6 measured; two divisions and a root in sequence"),
    "channels": (256, "13 measured, in normals whose sum nearly cancels; otherwise as blend"),
    "deep": (256, "27 measured; as blend"),
    "deep_merge": (256, "4 measured; as blend"),
    "holdout": (256, "8 measured; as blend"),
    "rays": (512, "47 measured; directions and rays have several quotients and roots, which may be off by 3 ulp"),
    "masks": (128, "as loss"),
    "loss": (128, "9 measured; six times as much if the quotients of SSIM are off by 3 ulp"),
    "blend_grad": (1024, "32 measured; up to 64 divisions in sequence recover the transmittance"),
    "project_grad": (512, "39 measured, at opacities near 1; six times as much if divisions are off by 3 ulp"),
    "penalties": (32, "2 measured; an exponential and a product"),
    "adam": (32, "2 measured; one root and one division"),
    "noise": (256, "15 measured; 1 ulp of the opacity o is 16 ulp of 100 (o - dead), and sums over axes cancel"),
    "statistics": (32, "1 measured; one root"),
    **dict.fromkeys(
        COLOUR_MODELS, (1024, "202 measured; float32 beta2 is off by 1e-5 of 1 - beta2, 84 ulp; sums over a picture")
    ),
    "grid": (1024, "227 measured; as exposure"),
    "depth": (1024, "as blend_grad"),
    "pose": (1024, "as exposure; sums of terms with both signs"),
    "lens": (1024, "19 measured; as pose"),
    "bounds": (0, "minima and maxima"),
    "chunks": (512, "211 measured, in second moments: beta2 in float32 is off by 1.3e-5 of 1 - beta2, up to 216 ulp"),
    "catch_up": (64, "8 measured, in first moments: beta1 in float32 is off by 2.6e-8 in each of 20 steps"),
    "chunk_records": (0, "copies of words"),
    "region": (0, "each result is copied from one without a region, or is a constant"),
    "ewa": (1024, "95 measured, in the gradient of quaternions, whose terms cancel; else as project_grad"),
    "harmonics": (64, "10 measured; one root and one division"),
    "splats": (64, "2 measured; a root and two quotients"),
    "values": (1024, "71 measured; as blend_grad"),
}
"""Error bound of each stage in ulp, and the reason for it.

"N measured" is the largest error in ulp on a device whose operations all round as IEEE 754 demands. The bounds leave
room for GPUs whose divisions and roots do not. If an operation is wrong, results are off by thousands of ulp.
"""


def stages_of_training(config: TrainConfig, *, region: bool = False) -> tuple[str, ...]:
    """Return the names of the self-test's stages that training with these settings uses.

    region: True if only the Gaussians of a region are trained. Their pixels are found by channels, and masked.
    """
    return (
        *TRAINING_STAGES,
        *CHUNK_STAGES,
        *((*CHANNEL_STAGES, *REGION_STAGES) if region else ()),
        *(MASK_STAGES if region or config.mask_use != NO_MASKS else ()),
        *(() if config.appearance == "none" else APPEARANCE_STAGES),
        *(DEPTH_STAGES if config.depth_use else ()),
        *(POSE_STAGES if config.refine_poses else ()),
        *(LENS_STAGES if config.refine_lenses else ()),
    )


@dataclass(frozen=True)
class Result:
    """The self-test's result of a stage over all frozen scenes.

    absolute, ulp: the largest absolute error, and the largest error in ulp.
    bound: the error bound in ulp.
    same_bits: True if the bits of the results match the stored digest; None if no digest is stored for this shape.
    ms: milliseconds that the stage took on all scenes.
    trouble: description of a fault other than too large an error, or empty.
    where: name of the quantity with the largest error in ulp, such as "image".
    otherwise: names of the operations that do not round as IEEE 754 demands, such as "division".
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
        """True if the stage can be trusted. Bits that differ from the digest are not a failure."""
        return not self.trouble and self.ulp <= self.bound
