# SPDX-License-Identifier: Apache-2.0
"""`Meta`, the third result of `rasterization`: a dictionary that computes some entries on first access."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from clsplat.torch.compile_guards import outside_graphs


class Meta(dict[str, Any]):
    """A dictionary whose entries may be computed on first access, by a function that runs once.

    It behaves like a dictionary with all entries, with one exception: if an entry is changed in place, entries that are
    computed from it later use the changed values.
    """

    def __init__(self, entries: dict[str, Any]) -> None:
        super().__init__(entries)
        self._makers: dict[str, Callable[[], dict[str, Any]]] = {}

    def later(self, names: tuple[str, ...], make: Callable[[], dict[str, Any]]) -> None:
        """Add entries `names`, which a call of `make` computes on the first access to one of them."""
        for name in names:
            super().__setitem__(name, None)
            self._makers[name] = make

    @outside_graphs
    def _made(self, name: object) -> None:
        if name in self._makers:
            for key, value in self._makers[str(name)]().items():
                if self._makers.pop(key, None):
                    super().__setitem__(key, value)

    def _made_all(self) -> None:
        for name in list(self._makers):
            self._made(name)

    def __getitem__(self, name: str) -> Any:
        self._made(name)
        return super().__getitem__(name)

    def get(self, name: str, default: Any = None) -> Any:
        """The entry, or `default` if there is none."""
        return self[name] if name in self else default  # noqa: SIM401  # the suggested code would call this method again

    def __setitem__(self, name: str, value: Any) -> None:
        self._makers.pop(name, None)
        super().__setitem__(name, value)

    def __delitem__(self, name: str) -> None:
        self._makers.pop(name, None)
        super().__delitem__(name)

    def __iter__(self) -> Iterator[str]:  # without this override, dict(meta) would bypass __getitem__
        return super().__iter__()

    def update(self, *given: Any, **named: Any) -> None:
        """Set entries, like `dict.update`."""
        for name, value in dict(*given, **named).items():
            self[name] = value

    def __ior__(self, other: Any) -> Meta:  # type: ignore[override]  # noqa: PYI034  # typing has Self since 3.11
        self.update(other)
        return self

    def clear(self) -> None:
        """Remove all entries."""
        self._makers.clear()
        super().clear()

    def popitem(self) -> tuple[str, Any]:
        """Remove the last entry, and return its name and value."""
        if not self:
            raise KeyError("popitem(): dictionary is empty")
        name = next(reversed(self))
        return name, self.pop(name)

    def values(self) -> Any:
        """Compute all entries, and return a view of their values."""
        self._made_all()
        return super().values()

    def items(self) -> Any:
        """Compute all entries, and return a view of their names and values."""
        self._made_all()
        return super().items()

    def pop(self, name: str, *default: Any) -> Any:
        """Remove an entry, and return it."""
        self._made(name)
        return super().pop(name, *default)

    def setdefault(self, name: str, default: Any = None) -> Any:
        """The entry, set to `default` if there is none."""
        self._made(name)
        return super().setdefault(name, default)

    def copy(self) -> dict[str, Any]:
        """A plain dictionary, with every entry computed."""
        return dict(self.items())

    def __repr__(self) -> str:
        return repr(self.copy())

    def __eq__(self, other: object) -> bool:
        return self.copy() == other

    __hash__ = None

    def __or__(self, other: Any) -> Any:
        return self.copy() | other

    def __ror__(self, other: Any) -> Any:
        return other | self.copy()

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (self.copy(),)
