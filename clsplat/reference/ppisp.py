# SPDX-License-Identifier: Apache-2.0
"""Colour model `ppisp`: gains and colour mixes of a photograph, the vignette of its lens, and their gradient.

Float64 twin of kernels/ppisp.cl. The model is a part of PPISP (NVIDIA 2026), with a colour matrix that keeps grey.
"""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64


def unmixing(mixes: Float64) -> Float64:
    """Return the colour matrix (3, 3) that removes the mixes of channels.

    mixes: (6,), for each channel c, the fractions of channels c + 1 and c + 2 (modulo 3) that are mixed into it.
    """
    matrix = np.eye(3)
    for c in range(3):
        for k in range(2):
            matrix[c, (c + 1 + k) % 3] -= mixes[2 * c + k]
            matrix[c, c] += mixes[2 * c + k]
    return matrix


def light(vignette: Float64, squared: Float64) -> Float64:
    """Return the fraction of light (H, W) that a lens with this vignette (3,) transmits.

    squared: (H, W), squared distances from the principal point (`reference.appearance.spread`).
    """
    result: Float64 = np.exp2(squared * (vignette[0] + squared * (vignette[1] + squared * vignette[2])))
    return result


def developed(photograph: Float64, entries: Float64, vignette: Float64, squared: Float64) -> Float64:
    """Convert the photograph (H, W, 3) to the model's colours: remove gains, vignette and mixes.

    entries: (9,), three log2 gains, then six mixes. vignette, squared: as for `light`.
    """
    even = photograph / np.exp2(entries[:3]) / light(vignette, squared)[:, :, None]
    result: Float64 = even @ unmixing(entries[3:]).T
    return result


def terms(image: Float64, by_image: Float64, squared: Float64) -> Float64:
    """Return each pixel's terms (H, W, 12) of the gradient of a loss with respect to entries (9) and vignette (3).

    The gradient is at entries and vignette of 0.

    by_image: (H, W, 3), gradient of the loss with respect to the image after entries and vignette are applied.
    """
    each = image * by_image
    others = [image[:, :, (c + 1 + k) % 3] - image[:, :, c] for c in range(3) for k in range(2)]
    mixes = [other * by_image[:, :, place // 2] for place, other in enumerate(others)]
    powers = [np.log(2) * squared**power * each.sum(axis=2) for power in (1, 2, 3)]
    result: Float64 = np.concatenate([np.log(2) * each, np.stack([*mixes, *powers], axis=-1)], axis=-1)
    return result
