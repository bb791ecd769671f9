# SPDX-License-Identifier: Apache-2.0
"""The groups of `clsplat render --help`: the flags that most need, then all others by what they are for."""

from __future__ import annotations

from clsplat.cli.flags import Groups

MOST = (
    *("output", "cameras", "path", "frames", "width", "height", "channels", "colorspace"),
    *("shutter-angle", "skip-existing", "device", "dry-run"),
)
"""Twelve flags, beside the model."""
RENDER_GROUPS: Groups = (
    ("Needed most", ("RUN|MODEL", *MOST)),
    ("Cameras, paths and where the model is", ("count", "up", "usd-camera", "lenses", "transform")),
    ("Resolution and framing (and --width, --height)", ("scale", "overscan", "region", "supersample", "filter")),
    ("Channels and background (and --channels)", ("alpha", "background", "appearance", "ids-from")),
    ("Colour space (and --colorspace)", ("model-colorspace", "ocio-config")),
    ("Motion blur (and --shutter-angle)", ("samples", "shutter-open", "shutter-close")),
    ("Depth of field (and --samples)", ("f-stop", "aperture", "focus", "sensor-width", "metres")),
    ("Lenses that bend", ("stmap", "distort")),
    ("Stereo", ("stereo", "convergence", "eye")),
    ("Deep EXR", ("deep", "deep.*")),
    ("Hold-outs", ("holdout", "holdout.*", "holdout-*")),
    ("Files of pictures", ("exr", "parts", "compression", "bits", "quality", "overwrite")),
    ("Video", ("video.*",)),
    ("Speed and approximations", ("preset", "rasterizer.*")),
    ("Devices, memory and farms (and --device)", ("max-device-mem", "workers", "scheduler")),
    ("Reports", ("progress", "json", "profile")),
)
