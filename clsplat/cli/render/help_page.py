# SPDX-License-Identifier: Apache-2.0
"""Groups of `clsplat render --help`: the flags that are most often needed, then all others by purpose."""

from __future__ import annotations

from clsplat.cli.flags import Groups

MOST_NEEDED_FLAGS = (
    *("output", "cameras", "path", "frames", "width", "height", "channels", "colorspace"),
    *("shutter-angle", "skip-existing", "device", "dry-run"),
)
"""Flags that the first group of the help lists, below the model."""
RENDER_GROUPS: Groups = (
    ("Needed most", ("RUN|MODEL", *MOST_NEEDED_FLAGS)),
    (
        "Cameras, frames and paths (and --cameras, --frames, --path)",
        ("count", "up", "usd-camera", "lenses", "transform"),
    ),
    ("Resolution and framing (and --width, --height)", ("scale", "overscan", "region", "supersample", "filter")),
    ("Channels and background (and --channels)", ("alpha", "background", "appearance", "ids-from")),
    ("Colour space (and --colorspace)", ("model-colorspace", "ocio-config")),
    ("Motion blur (and --shutter-angle)", ("samples", "shutter-open", "shutter-close")),
    ("Depth of field (and --samples)", ("f-stop", "aperture", "focus", "sensor-width", "metres")),
    ("Lens distortion", ("stmap", "distort")),
    ("Stereo", ("stereo", "convergence", "eye")),
    ("Deep EXR", ("deep", "deep.*")),
    ("Holdouts", ("holdout", "holdout.*", "holdout-*")),
    ("Image files", ("exr", "parts", "compression", "bits", "quality", "overwrite")),
    ("Video", ("video.*",)),
    ("Speed and approximations", ("preset", "rasterizer.*")),
    ("Devices, memory and farms (and --device)", ("max-device-mem", "workers", "scheduler")),
    ("Reports", ("progress", "json", "profile")),
)
