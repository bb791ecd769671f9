# SPDX-License-Identifier: Apache-2.0
"""Gains and colour mixes of a photograph, the vignette of its lens, and their gradient.

Float64 twin of kernels/ppisp.cl. It is a part of PPISP (NVIDIA 2026), with a colour matrix that keeps grey.
"""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64


def unmixing(mixes: Float64) -> Float64:
    """The matrix (3, 3) that removes the mixes (6,): for each channel c, the fractions of channels c + 1 and c + 2."""
    matrix = np.eye(3)
    for c in range(3):
        for k in range(2):
            matrix[c, (c + 1 + k) % 3] -= mixes[2 * c + k]
            matrix[c, c] += mixes[2 * c + k]
    return matrix


def light(vignette: Float64, squared: Float64) -> Float64:
    """The fraction of light (H, W) that a lens with this vignette (3,) transmits at these squared distances."""
    result: Float64 = np.exp2(squared * (vignette[0] + squared * (vignette[1] + squared * vignette[2])))
    return result


def developed(photograph: Float64, entries: Float64, vignette: Float64, squared: Float64) -> Float64:
    """Convert the photograph (H, W, 3) to the model's colours: remove gains, vignette and mixes."""
    even = photograph / np.exp2(entries[:3]) / light(vignette, squared)[:, :, None]
    result: Float64 = even @ unmixing(entries[3:]).T
    return result


def terms(image: Float64, by_image: Float64, squared: Float64) -> Float64:
    """Terms (H, W, 12) of a loss's gradient with respect to the entries and the vignette, at values of 0.

    by_image: (H, W, 3), the gradient of the loss with respect to the image after they are applied.
    """
    each = image * by_image
    others = [image[:, :, (c + 1 + k) % 3] - image[:, :, c] for c in range(3) for k in range(2)]
    mixes = [other * by_image[:, :, place // 2] for place, other in enumerate(others)]
    powers = [np.log(2) * squared**power * each.sum(axis=2) for power in (1, 2, 3)]
    result: Float64 = np.concatenate([np.log(2) * each, np.stack([*mixes, *powers], axis=-1)], axis=-1)
    return result
