# SPDX-License-Identifier: Apache-2.0
"""What each Gaussian contributes to an image, from the slots of blend_grad.cl: a closed form, and itself in bands.
test_project.py has them beside the twin."""

from __future__ import annotations

import numpy as np
import pytest
import scenes
from compare import assert_close, assert_same_arrays, assert_same_bits
from pipeline import Pipeline
from quick import quick
from test_bands import in_bands, most_in_a_tile

from clsplat.chunks.gathering import row_entries
from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.layouts.columns import SLOT, SlotFields
from clsplat.stages.density import CONTRIBUTION_STATISTICS, add_contributions, carried, new_statistics
from clsplat.stages.project import Projected

WITH = SlotFields(contributions=True)


def noise(run: Pipeline) -> np.ndarray:
    return np.random.default_rng(2).standard_normal((run.camera.height, run.camera.width, 3))


def contributions(run: Pipeline, fields: SlotFields = WITH) -> np.ndarray:
    """(n,), 0 where not visible."""
    _, screen = run.screened(noise(run), fields)
    assert screen.contributions is not None
    return np.where(run.visible, screen.contributions.get(), np.float32(0))


@pytest.mark.parametrize("size", quick([(1, 1), (17, 15), (33, 1), (64, 48)], (17, 15), (33, 1)), ids=str)
def test_they_add_up_to_what_is_opaque(shaped_device: Device, size: tuple[int, int]) -> None:
    """Weights and what is left add up to 1 in every pixel: no pixel outside the image counts, none counts twice."""
    run = Pipeline.run(shaped_device, scenes.random_cloud(200, 3, *size))
    opaque = (1 - run.crop(run.frame.blended.transmittance.get()).astype(np.float64)).sum()
    assert opaque > 0
    # a rounding per Gaussian and pixel, in transmittance recovered by division
    assert_close(contributions(run).astype(np.float64).sum(), opaque, relative=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("absolute", [False, True])
def test_gradients_keep_their_bits(shaped_device: Device, absolute: bool) -> None:
    run = Pipeline.run(shaped_device, scenes.overlap())
    plain, screen = run.screened(noise(run), SlotFields(absolute))
    both, screen_of_both = run.screened(noise(run), SlotFields(absolute, contributions=True))
    assert screen.contributions is None
    assert_same_arrays(both.arrays(), plain.arrays())
    shown = run.visible
    assert_same_bits(screen_of_both.gradients.get()[shown], screen.gradients.get()[shown])


@pytest.mark.slow
@pytest.mark.parametrize("absolute", [False, True])
def test_bands_change_no_bit(default_device: Device, absolute: bool) -> None:
    whole = Pipeline.run(default_device, scenes.overlap())
    banded = in_bands(default_device, "overlap", most_in_a_tile(whole))
    assert len(banded.frame.bands) > 1
    fields = SlotFields(absolute, contributions=True)
    assert_same_bits(contributions(banded, fields), contributions(whole, fields))


def test_the_place_in_a_slot() -> None:
    assert SlotFields().floats == 9
    assert SlotFields(absolute=True).floats == len(SLOT) == 11
    assert SlotFields(contributions=True).floats == 10
    assert SlotFields(absolute=True, contributions=True).floats == 12


@pytest.mark.parametrize("count", [1, 63, 64, 65, 1025])
def test_epochs(device: Device, count: int) -> None:
    """Nothing is known before an epoch begins; then totals and the largest of its views, and those of the last one."""
    rng = np.random.default_rng(count)
    statistics = new_statistics(device, count, contributions=True)

    def view(area: float) -> np.ndarray:
        tiles = rng.integers(0, 2, count).astype(np.uint32)
        values = rng.uniform(0.1, 5, count).astype(np.float32)
        splats = upload(device, np.zeros((count, 16), np.float32))
        add_contributions(device, statistics, Projected(splats, upload(device, tiles)), upload(device, values), area)
        return np.where(tiles > 0, np.float32(area) * values, np.float32(0))

    view(1.0)
    assert statistics.current_totals is not None and statistics.current_largest is not None
    assert np.isinf(statistics.current_totals.get()).all(), "the epoch had begun before"
    for _ in range(3):
        statistics = statistics.next_epoch()
        views = [view(area) for area in (1.0, 4.0, 1.0)]
        assert statistics.current_totals is not None and statistics.current_largest is not None
        assert_same_bits(statistics.current_totals.get(), views[0] + views[1] + views[2])
        assert_same_bits(statistics.current_largest.get(), np.maximum.reduce(views))
        before = statistics
    statistics = statistics.next_epoch()
    assert statistics.whole_totals is before.current_totals
    assert statistics.current_totals is not None and statistics.current_largest is not None
    assert not statistics.current_totals.get().any()
    assert not statistics.current_largest.get().any()
    statistics.forget_contributions()
    for name in CONTRIBUTION_STATISTICS:
        assert np.isinf(statistics.named()[name].get()).all()


def test_what_goes_on_when_rows_move(device: Device) -> None:
    statistics = new_statistics(device, 4, contributions=True)
    for index, array in enumerate(statistics.named().values()):
        array.set(np.arange(4, dtype=np.float32) + 10 * index)
    names = list(statistics.named())
    assert names == [
        *("gradient_sums", "seen", "radii"),
        *("current_totals", "current_largest", "whole_totals", "whole_largest"),
    ]
    rows, fresh = np.array([0, 2, 3, 2], np.uint32), np.array([False, False, False, True])
    listed, work = upload(device, row_entries(rows, fresh)), Workspace(device)
    densified = carried(device, work, listed, statistics.named(), densified=True)
    for index, (name, array) in enumerate(densified.named().items()):
        wanted = np.array([0, 2, 3, np.inf]) + 10 * index if name in CONTRIBUTION_STATISTICS else np.zeros(4)
        np.testing.assert_array_equal(array.get(), wanted, f"{name}: all else starts again")
    pruned = carried(device, work, row_entries(rows[:3], None), statistics.named(), densified=False)
    for index, array in enumerate(pruned.named().values()):
        np.testing.assert_array_equal(array.get(), np.array([0, 2, 3]) + 10 * index)
