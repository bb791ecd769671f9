# SPDX-License-Identifier: Apache-2.0
"""Cases: comparisons of a stage with its float64 twin. Each has inputs, a launch, the twin's values, and error bounds.

The self-test runs cases on the frozen scenes, and `tests/stages/test_cases.py` at edge sizes on every driver.
`tools/stress/run kernels` runs them on thousands of random inputs, and `tools/ci/check_memory.py` on small inputs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import EllipsisType, SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray

from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.layouts.columns import READBACK
from clsplat.selftest.harness import Array, CaseBench, StageOutcome, joined

Arrays = dict[str, Array]
Read = Callable[[], Arrays]
"""Function that reads the results of a launch from the device, by name."""
Mask = NDArray[np.bool_] | EllipsisType
"""Mask of the elements that are compared; `...` compares all."""


class Inputs(SimpleNamespace):
    """Inputs of a case: arrays and numbers, as attributes. Images are (H, W, ...)."""

    @property
    def size(self) -> tuple[int, int]:
        """The (width, height) of `image`."""
        return self.image.shape[1], self.image.shape[0]

    def wide(self, *names: str) -> list[NDArray[np.float64]]:
        """Convert the inputs with these names to float64."""
        return [getattr(self, name).astype(np.float64) for name in names]


@dataclass(frozen=True, eq=False)
class Expected:
    """The twin's values of a result, and how the device's values are compared with them.

    bound: the largest allowed error. A comment beside each bound gives the reason for it.
    magnitudes: for each element, the number by which its error is divided. None: the error is the 2-norm of all errors,
    divided by the 2-norm of all values.
    compared: mask of the elements that are compared; all other elements depend on rounding.
    exact: True for results that must be equal, such as integers.
    """

    values: Array
    bound: float
    magnitudes: ArrayLike | None = None
    compared: Mask = ...
    exact: bool = False

    def error_of(self, got: Array) -> float:
        """Return the error of the device's values `got`. The caller compares the error with `bound`.

        The error is the largest one after division by the magnitudes, or without them the relative error in the
        2-norm. If `exact` is True, it is the number of wrong elements.
        """
        if got.shape != self.values.shape:
            return float("inf")
        found, wanted = got[self.compared], self.values[self.compared]
        if self.exact:
            return float(np.count_nonzero(found != wanted))
        if not np.isfinite(found).all():
            return float("inf")
        off = np.abs(found.astype(np.float64) - wanted)
        if self.magnitudes is None:
            error, scale = np.linalg.norm(off), np.linalg.norm(wanted)
            return float(error / scale) if scale > 0 else float("inf") if error > 0 else 0.0
        size = np.broadcast_to(np.asarray(self.magnitudes, np.float64), self.values.shape)[self.compared]
        return float((off / np.maximum(size, 1e-30)).max(initial=0.0))


def exactly(values: Array) -> Expected:
    """Expect a result to be equal to the twin's values."""
    return Expected(values, 0.0, exact=True)


class Deviation(NamedTuple):
    """The error of a result, and the bound of the error."""

    error: float
    bound: float


def faults(found: Mapping[str, Deviation]) -> list[str]:
    """Describe each error that exceeds its bound. found: the errors and bounds, by the names of the results."""
    return [f"{name} {error:.2g} over {bound:g}" for name, (error, bound) in found.items() if not error <= bound]


@dataclass(frozen=True, eq=False)
class Case:
    """The comparison of a stage with its float64 twin.

    sizes: numbers of rows, or (width, height) of images, that are edge cases of the kernels, such as one row more than
    a group has.
    random: function that makes random inputs of a size.
    launch: function that launches the kernels, and returns a function that reads the results.
    twin: function from inputs and the device's results to the wanted values by name. It is given the device's results
    because a gradient, for example, depends on the device's projection.
    frozen: function from a frozen scene of the self-test to a list of inputs; None if the case is not a stage of the
    self-test.
    digested: names of the results in the self-test's digest, in order.
    by_shape: True if the kernels or their launches depend on the kernel shape.
    own_bits_of_groups: True if the bits, and so the digest, depend on whether a kernel shape has one or several items.
    """

    sizes: Sequence[Any]
    random: Callable[[Generator, Any], Inputs]
    launch: Callable[[Device, Workspace, Inputs], Read]
    twin: Callable[[Inputs, Arrays], Mapping[str, Expected]]
    frozen: Callable[[CaseBench], Sequence[Inputs]] | None = None
    digested: tuple[str, ...] = ()
    by_shape: bool = True
    own_bits_of_groups: bool = False

    def errors(self, device: Device, given: Inputs, work: Workspace | None = None) -> dict[str, Deviation]:
        """Launch the kernels on the inputs. Returns the error and the bound of each result by name."""
        got = self.launch(device, work or Workspace(device), given)()
        return {name: Deviation(each.error_of(got[name]), each.bound) for name, each in self.twin(given, got).items()}

    def outcome(self, bench: CaseBench) -> StageOutcome:
        """Run this case as a stage of the self-test, on the frozen scene of `bench`, and return the outcome."""
        assert self.frozen is not None
        return joined([self._outcome(bench, given) for given in self.frozen(bench)])

    def _outcome(self, bench: CaseBench, given: Inputs) -> StageOutcome:
        # A separate workspace, because later stages need the results in the bench's workspace.
        work = Workspace(bench.device)
        got: Arrays = {}

        def take(read: Read) -> list[Array]:
            got.update(read())
            return [got[name] for name in self.digested]

        _, outcome = bench.twice(lambda: self.launch(bench.device, work, given), take)
        expected = self.twin(given, got)
        parts = {
            name: (got[name][each.compared], each.values[each.compared])
            for name, each in expected.items()
            if not each.exact
        }
        wrong = {name: int(each.error_of(got[name])) for name, each in expected.items() if each.exact}
        return outcome.compared(parts, **wrong)


def read_of(arrays: Mapping[str, DeviceArray]) -> Read:
    """Return a function that reads these arrays from the device, by name."""
    return lambda: {name: array.get() for name, array in arrays.items()}


def fresh_readback(device: Device) -> DeviceArray:
    """Upload zeros for all READBACK columns, which mean that no step has stopped and that Adam has refused nothing."""
    return upload(device, np.zeros(len(READBACK), np.uint32))
