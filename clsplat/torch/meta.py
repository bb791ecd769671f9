# SPDX-License-Identifier: Apache-2.0
"""The third result of `rasterization`: a dictionary some of whose entries are made when they are first looked at."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from clsplat.torch.graphs import outside_graphs


class Meta(dict[str, Any]):
    """A dictionary with entries that functions make: each is called once, at the first look at one of its names.

    Equal in all but time to the dictionary with every entry made; but where one is changed in place, those that are
    made of it later are of what it is then.
    """

    def __init__(self, entries: dict[str, Any]) -> None:
        super().__init__(entries)
        self._makers: dict[str, Callable[[], dict[str, Any]]] = {}

    def later(self, names: tuple[str, ...], make: Callable[[], dict[str, Any]]) -> None:
        """Let `make`, which returns an entry for each of `names`, be called when one of them is looked at."""
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
        """The entry, or `default` where there is none."""
        return self[name] if name in self else default  # noqa: SIM401  # what it would be replaced with

    def __setitem__(self, name: str, value: Any) -> None:
        self._makers.pop(name, None)
        super().__setitem__(name, value)

    def __delitem__(self, name: str) -> None:
        self._makers.pop(name, None)
        super().__delitem__(name)

    def __iter__(self) -> Iterator[str]:  # one of its own, or dict(meta) takes the values past __getitem__
        return super().__iter__()

    def update(self, *given: Any, **named: Any) -> None:
        """Set entries, as of a dictionary."""
        for name, value in dict(*given, **named).items():
            self[name] = value

    def __ior__(self, other: Any) -> Meta:  # type: ignore[override]  # noqa: PYI034  # typing has Self from 3.11 on
        self.update(other)
        return self

    def clear(self) -> None:
        """Take all entries out."""
        self._makers.clear()
        super().clear()

    def popitem(self) -> tuple[str, Any]:
        """The last name and its entry, which is taken out."""
        if not self:
            raise KeyError("popitem(): dictionary is empty")
        name = next(reversed(self))
        return name, self.pop(name)

    def values(self) -> Any:
        """A view of the values, all of them made."""
        self._made_all()
        return super().values()

    def items(self) -> Any:
        """A view of names and values, all of them made."""
        self._made_all()
        return super().items()

    def pop(self, name: str, *default: Any) -> Any:
        """The entry, which is taken out."""
        self._made(name)
        return super().pop(name, *default)

    def setdefault(self, name: str, default: Any = None) -> Any:
        """The entry, which becomes `default` where there is none."""
        self._made(name)
        return super().setdefault(name, default)

    def copy(self) -> dict[str, Any]:
        """A plain dictionary."""
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
