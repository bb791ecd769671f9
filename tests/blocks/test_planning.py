# SPDX-License-Identifier: Apache-2.0
"""Blocks by number, by limits and by what can be trained, with given contributions in place of a coarse model."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from calls import warned
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.blocks.plan import Partition, Sky
from clsplat.blocks.planning.coarse import sky_steps
from clsplat.blocks.planning.measurement import SKY_EXTENTS, LoadMeasurement
from clsplat.blocks.planning.new_plan import divided
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError

STREET_METRES = 100
SKY = Sky((0.0, 0.0, 0.0), 1e3)


class GivenLoads(LoadMeasurement):
    """Photographs along a street: each shows the Gaussians up to `reach` metres from its camera equally.

    cameras: places of the cameras along the street. gaussians: places of the Gaussians.
    """

    def __init__(self, cameras: Any, gaussians: Any, reach: float) -> None:
        super().__init__(*cast("tuple[Any, Any, Any, Any, Any, Any]", [None] * 6))
        self.along, self.reach, self.passes, self.coarse = np.asarray(gaussians, float), reach, 0, 0
        self.__dict__["camera_places"] = on_street(cameras)
        self.__dict__["coordinates"] = on_street(gaussians)
        self.__dict__["_sky_rows"] = np.zeros(len(self.along), np.bool_)
        self.model = cast("Any", self.along)

    def bytes_needed(self, gaussians: float) -> int:
        return round(self.coarse + 10 * gaussians)

    def _contributions(self, text: str) -> Iterator[Float32]:
        assert text
        self.passes += 1
        for place in self.camera_places[:, 0]:
            yield (np.abs(self.along - place) <= self.reach).astype(np.float32)


def on_street(places: Any) -> NDArray[np.float64]:
    return np.stack([np.asarray(places, float), np.zeros(len(places))], axis=1)


def street(reach: float = 5.0) -> GivenLoads:
    """A camera every two metres, and a Gaussian every half."""
    return GivenLoads(np.arange(0, STREET_METRES, 2), np.arange(0, STREET_METRES, 0.5), reach)


@pytest.mark.parametrize("blocks", ["1", "3", "4", "2x1", "4x2"])
def test_every_photograph_belongs_to_a_block(blocks: str) -> None:
    loads, notes = divided(street(), Partition(blocks))
    assert notes == []
    assert len(loads.names) == (4 if blocks == "4x2" else int(np.prod([int(word) for word in blocks.split("x")])))
    assert loads.belongs.any(axis=1).all()
    assert loads.inside.sum() == STREET_METRES / 0.5
    assert (loads.around >= loads.inside).all()


def test_photographs_near_a_cut_belong_to_both_sides() -> None:
    loads, _ = divided(street(), Partition("2"))
    # the cut is at 49 m, and a photograph shows 21 Gaussians: that at 46 m has 5 of them beyond the cut, that at 52 m 4
    both = np.flatnonzero(loads.belongs.all(axis=1))
    assert (2 * both).tolist() == [46, 48, 50]


def test_auto_is_one_block_if_everything_fits() -> None:
    measured = GivenLoads(np.arange(0, STREET_METRES, 2), np.arange(0, STREET_METRES, 0.5), 5.0)
    loads, _ = divided(measured, Partition("auto", memory=10 * 200))
    assert loads.names == ("0_0",)
    assert measured.passes == 2  # for the places, and for the loads


def test_auto_cuts_until_the_limits_are_met() -> None:
    loads, _ = divided(street(), Partition("auto", memory=10 * 75))
    assert loads.around.max() <= 75 and len(loads.names) == 4
    loads, _ = divided(street(), Partition("auto", memory=10**6, photographs=16))
    assert loads.belongs.sum(axis=0).max() <= 16
    assert len(loads.names) <= 5  # 50 photographs, and a few in two blocks at each of the cuts


def test_limits_that_no_division_meets_are_refused() -> None:
    wide = street(reach=1000.0)  # each photograph shows the whole street
    with pytest.raises(InputError, match=r"--block-photographs 20: the largest of \d blocks would still have 50 photo"):
        divided(wide, Partition("auto", memory=10**6, photographs=20))
    heap = GivenLoads(np.arange(0, STREET_METRES, 2), np.full(300, 50.0), 60.0)
    with pytest.raises(InputError, match=r"--block-mem 100 bytes: the largest of \d blocks? would still take"):
        divided(heap, Partition("auto", memory=100))
    heap.device = cast(
        "Any", SimpleNamespace(budget=100)
    )  # the limit if none is given: then blocks are trained in pieces
    loads, _ = warned(
        "would still take .*but this device has 100 bytes: training will run in pieces",
        divided,
        heap,
        Partition("auto"),
    )
    assert loads.belongs.any(axis=1).all()
    heap.coarse = 200  # bytes of the Gaussians around a block, however small it is
    with pytest.raises(InputError, match=r"--block-mem 100 bytes: the coarse model, .*takes 200 bytes; expected more"):
        divided(heap, Partition("auto", memory=100))
    loads, _ = warned(
        "the coarse model, .*takes 200 bytes, but this device has 100 bytes", divided, heap, Partition("auto")
    )
    assert loads.names == ("0_0",)


def test_a_cell_without_points_is_joined() -> None:
    cameras = np.arange(0, STREET_METRES, 2)
    half = GivenLoads(cameras, np.arange(0, STREET_METRES / 2, 0.5), 5.0)  # nothing is known of the street's other half
    loads, notes = divided(half, Partition("4x1"))
    assert notes == ["block 3,0 has no points: its cell is joined to block 2,0"]
    assert loads.names == ("0_0", "1_0", "2_0")
    assert loads.cells[-1].high[0] == np.inf
    assert loads.inside.min() > 0 and loads.belongs.any(axis=0).all()


def test_a_cell_with_one_camera_is_joined() -> None:
    cameras = [0.0, 1.0, 2.0, 3.0, 20.0, 20.0, 20.0, 20.0]
    loads, notes = divided(GivenLoads(cameras, np.arange(0, 24, 0.5), 2.0), Partition("2"))
    assert notes == ["block 1,0 has one camera: its cell is joined to block 0,0"]
    assert loads.names == ("0_0",) and loads.belongs.all()


def test_a_cell_without_photographs_is_joined() -> None:
    class AsidePlaces(GivenLoads):
        """As if half of the photographs showed a place where only a small part of their pixels is."""

        def _contributions(self, text: str) -> Iterator[Float32]:
            for weights in super()._contributions(text):
                far = np.where(self.along > 50, 0.01 if text.startswith("measuring") else 0.0, 1.0)
                yield (weights * far).astype(np.float32)

    loads, notes = divided(AsidePlaces(np.arange(0, 80, 2), np.arange(0, 80, 0.5), 40.0), Partition("1"))
    assert notes == [] and loads.belongs.all()
    measured = AsidePlaces(np.arange(0, 80, 2), np.arange(0, 80, 0.5), 40.0)
    measured.__dict__["places"] = on_street(np.arange(0, 80, 2) + 25.0)
    loads, notes = divided(measured, Partition("2"))
    assert notes == ["block 1,0 has no photographs: its cell is joined to block 0,0"]


def test_no_more_cells_are_joined_than_needed() -> None:
    """Two neighbours that have one camera each make one cell with two, which stays."""
    cameras = [0.0, 1.0, 2.0, 3.0, 20.0, 20.0, 30.0, 30.0]
    loads, notes = divided(GivenLoads(cameras, np.arange(0, 34, 0.5), 2.0), Partition("4"))
    assert notes == ["block 1,0 has one camera: its cell is joined to block 1,1"]
    assert len(loads.names) == 3
    assert "1_1" in loads.names
    assert loads.belongs.sum(axis=0).tolist()[-1] == 4


def under_the_sky(photographs: int) -> GivenLoads:
    """The street, and ten Gaussians above its end that the first photographs also show."""

    class WithSky(GivenLoads):
        def _contributions(self, text: str) -> Iterator[Float32]:
            for index, weights in enumerate(super()._contributions(text)):
                weights[-10:] = index < photographs
                yield weights

    along = np.append(np.arange(0, STREET_METRES, 0.5), np.full(10, 1e4))
    measured = WithSky(np.arange(0, STREET_METRES, 2), along, 5.0)
    measured.__dict__["_sky_rows"] = along > 1e3
    measured.__dict__["_sphere"] = SKY
    return measured


def test_the_sky_begins_beyond_some_extents() -> None:
    """Distances are from the middle of the cameras, in the world's coordinates."""
    measured = under_the_sky(30)
    del measured.__dict__["_sky_rows"], measured.__dict__["_sphere"]
    middle, origin = np.array([2e6, 0.0, -5.0]), np.array([2e6, 10.0, 0.0])
    measured.scene = cast("Any", SimpleNamespace(spread=(middle, 0.0, 0.0), extent=3.0))
    offsets = np.array([[14.9, 0, 0], [15.1, 0, 0], [0, -15.1, 0], [0, 10, 10], [9, 9, 9]])
    measured.model = cast("Any", SimpleNamespace(means=(offsets + middle - origin).astype(np.float32), origin=origin))
    assert measured._sky_rows.tolist() == [False, True, True, False, True]
    assert measured._sphere == Sky((2e6, 0.0, -5.0), SKY_EXTENTS * 3.0)
    assert SKY_EXTENTS == 5


def test_the_sky_is_in_no_cell() -> None:
    loads, notes = divided(under_the_sky(30), Partition("2"))
    ground, _ = divided(street(), Partition("2"))
    assert notes == [] and loads.sky is not None
    assert loads.sky.sphere is SKY
    assert np.flatnonzero(loads.sky.shown).tolist() == list(range(30))
    assert loads.inside.tolist() == ground.inside.tolist()
    assert loads.cells == ground.cells
    assert (loads.belongs == ground.belongs).all()


def test_a_sky_of_one_place_or_one_block_stays_in_the_cells() -> None:
    loads, _ = divided(under_the_sky(1), Partition("2"))
    assert loads.sky is None
    assert loads.inside.sum() == STREET_METRES / 0.5 + 10
    loads, _ = divided(under_the_sky(30), Partition("1"))
    assert loads.sky is None
    assert loads.inside.sum() == STREET_METRES / 0.5 + 10


def test_the_sky_takes_no_longer_than_a_block() -> None:
    config = TrainConfig(iterations=30_000)
    assert sky_steps(config, 200, 1000, 5000) == round(0.25 * 200 * 25_500 / 1000)
    assert sky_steps(config, 1000, 1000, 5000) == 5000
    assert sky_steps(config, 1, 10**6, 5000) == 1


def test_a_scene_that_cannot_be_trained_is_refused() -> None:
    nothing = GivenLoads(np.arange(0, 20, 2), np.arange(500, 520, 0.5), 5.0)
    nothing.scene = cast("Any", SimpleNamespace(source="survey", name="survey"))
    with pytest.raises(InputError, match="survey: the only block has no photographs, expected points of the coarse"):
        divided(nothing, Partition("2"))
    loads, notes = divided(GivenLoads(np.full(4, 3.0), np.arange(0, 20, 0.5), 5.0), Partition("2"))
    assert len(notes) == 1 and notes[0].startswith("block 0,0 has one camera, and there is no other block")
    assert loads.names == ("0_0",)
