# SPDX-License-Identifier: Apache-2.0
"""Writing of pictures with OpenImageIO, with the types and attributes that other programs may use."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray


def write_pixels(
    path: Path, pixels: NDArray[Any], kind: str = "", attributes: Mapping[str, Any] | None = None, **fields: Any
) -> Path:
    """Write pixels (H, W, C) to a file in the format of its extension. Returns the path.

    kind: OpenImageIO's name of the channels' type; by default the array's type.
    attributes: attributes of the file.
    fields: fields of OpenImageIO's ImageSpec.
    """
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, kind or pixels.dtype.name.replace("float32", "float"))
    for name, value in fields.items():
        setattr(spec, name, value)
    for name, value in (attributes or {}).items():
        spec.attribute(name, value)
    path.parent.mkdir(parents=True, exist_ok=True)
    output = oiio.ImageOutput.create(str(path))
    assert output is not None and output.open(str(path), spec), oiio.geterror()
    assert output.write_image(np.ascontiguousarray(pixels)) and output.close(), output.geterror()
    return path
