# SPDX-License-Identifier: Apache-2.0
"""The size that training works at, step by step."""

from __future__ import annotations

import numpy as np
import pytest

from clsplat.training.resolution import FACTORS, Sizes, by_doubling, by_spectra, sizes_of, spectrum_shares


def test_doubling() -> None:
    sizes = by_doubling((250, 500))
    assert [sizes.factor(step) for step in (1, 250, 251, 500, 501, 7000)] == [4, 4, 2, 2, 1, 1]
    assert by_doubling(()).factor(1) == 1


@pytest.mark.parametrize("shape", [(64, 64), (63, 96), (50, 33)])
def test_one_wave_is_held_by_the_sizes_that_can_show_it(shape: tuple[int, int]) -> None:
    """A wave of 0.1 to a pixel has its place in sizes down to 1/5 of the image: none of the window's skirts, which are
    a few bins wide, reach over the bounds at 0.0884 and 0.125 but for 2 % of the amplitude."""
    height, width = shape
    rows, columns = np.mgrid[:height, :width]
    for waves in (np.cos(2 * np.pi * 0.105 * rows), np.cos(2 * np.pi * 0.105 * columns)):
        image = np.repeat(0.5 + 0.4 * waves[..., None], 3, axis=2).astype(np.float32)
        shares = spectrum_shares(image)
        assert np.all(np.diff(shares) >= 0)
        below, above = shares[np.array(FACTORS) > 4 * 2**0.5 - 0.1], shares[np.array(FACTORS) < 3]
        assert below.max() < 0.5 < above.min()


def test_white_noise_has_the_share_of_the_square() -> None:
    """Every frequency weighs the same: the share is that of the square in the plane of frequencies, 1 / factor^2. Of
    200 x 300 amplitudes the mean is good to about 0.5 %, with the edge's bins 3 %."""
    image = np.random.default_rng(0).random((200, 300, 3), np.float32)
    np.testing.assert_allclose(spectrum_shares(image), [factor**-2 for factor in FACTORS], rtol=0.08)


def test_a_smoother_image_comes_to_its_full_size_later() -> None:
    rng = np.random.default_rng(1)
    noise = rng.random((96, 96, 1), np.float32)
    smooth = np.kron(rng.random((12, 12, 1), np.float32), np.ones((8, 8, 1), np.float32))
    fine, coarse = by_spectra([noise], 1000), by_spectra([smooth], 1000)
    assert fine.until[-1][0] < coarse.until[-1][0] < 1000
    assert [factor for _, factor in coarse.until] == list(FACTORS)


def test_a_blank_image_asks_for_no_small_sizes() -> None:
    assert by_spectra([np.full((40, 30, 3), 0.3, np.float32)], 1000) == Sizes(())


def test_spectra_only_where_asked_for() -> None:
    asked: list[int] = []

    def load(index: int) -> np.ndarray:
        asked.append(index)
        return np.random.default_rng(index).random((32, 32, 3), np.float32)

    assert sizes_of((3,), 0, 40, load) == by_doubling((3,))
    assert not asked
    assert len(sizes_of((3,), 500, 40, load).until) > 1
    assert len(asked) == len(set(asked)) == 16
    assert (asked[0], asked[-1]) == (0, 39)
    assert set(np.diff(asked)) <= {2, 3}, "evenly spread"
    asked.clear()
    sizes_of((3,), 500, 3, load)
    assert asked == [0, 1, 2]
