# SPDX-License-Identifier: Apache-2.0
"""A committed file of finished trainings, so that `tables.py` can make its tables over several days and machines."""

from __future__ import annotations

import ast
import hashlib
import io
import json
import re
import tokenize
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from itertools import accumulate
from pathlib import Path
from typing import Any

from clsplat.errors import InputError
from clsplat.files.atomic import atomic_write

CODE = ("kernels", "clsplat/config", "clsplat/device", "clsplat/rendering", "clsplat/stages", "clsplat/training")
"""Folders with the code on which a row's results are assumed to depend."""
ONLY_MCMC = "clsplat/training/density/mcmc.py"
"""Excluded for rows of other growths, which do not run it."""
COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)


@dataclass(frozen=True)
class Finished:
    """A finished training.

    settings: arguments other than steps, resolution and seed.
    code: `code_digest`.
    seconds: time on the device, whatever its other load.
    sizes: PSNR for each size at which pictures were also measured.
    """

    table: str
    row: str
    seed: int
    settings: tuple[str, ...]
    iterations: int
    resolution: int
    code: str
    commit: str
    device: str
    date: str
    psnr: float
    ssim: float
    gaussians: int
    seconds: float
    sizes: tuple[float, ...] = ()

    @property
    def key(self) -> tuple[Any, ...]:
        """A key that is equal for trainings of the same name, settings and code on any device."""
        return (self.table, self.row, self.seed, self.settings, self.iterations, self.resolution, self.code)


@dataclass(frozen=True)
class Same:
    """A person's statement that the code of two digests gives the same bytes, and how that was verified."""

    code: str
    was: str
    why: str


@dataclass(frozen=True)
class Kept:
    """The file of finished trainings: {"same": [...], "rows": [...]}. Each entry is a line, and lines are sorted, so
    that additions from two machines can be merged."""

    path: Path

    def find(self, wanted: Finished) -> Finished | None:
        """The finished training with the key of `wanted`, or with a code that is stated to be the same; else None."""
        rows, same = self._read()
        codes = {wanted.code}
        for _ in same:  # follows chains of statements
            codes |= {each.was for each in same if each.code in codes}
        found = [row for row in rows if row.code in codes and row.key[:-1] == wanted.key[:-1]]
        return min(found, key=lambda row: (row.code != wanted.code, row.date)) if found else None

    def has(self, code: str, *, mcmc: bool) -> bool:
        """True if there is a row with this code. mcmc: True for rows of growth mcmc, False for those of others."""
        return any(row.code == code and ("mcmc" in row.settings) == mcmc for row in self._read()[0])

    def add(self, row: Finished) -> None:
        """Add a row to the file. It replaces a row with the same key."""
        rows, same = self._read()
        self._write([*(other for other in rows if other.key != row.key), row], same)

    def say_same(self, statement: Same) -> None:
        """Add a statement to the file."""
        rows, same = self._read()
        self._write(rows, [*(other for other in same if other != statement), statement])

    def _read(self) -> tuple[list[Finished], list[Same]]:
        if not self.path.exists():
            return [], []
        try:
            told = json.loads(self.path.read_text("utf-8"))
            rows = [
                Finished(**{**row, "settings": tuple(row["settings"]), "sizes": tuple(row["sizes"])})
                for row in told["rows"]
            ]
            return rows, [Same(**each) for each in told["same"]]
        except (ValueError, TypeError, KeyError) as error:
            raise InputError(f"{self.path}: {error!r}: expected rows as tables.py writes them") from None

    def _write(self, rows: Sequence[Finished], same: Sequence[Same]) -> None:
        def lines(entries: Sequence[Finished | Same]) -> str:
            return ",".join(f"\n{line}" for line in sorted(json.dumps(asdict(each)) for each in entries))

        atomic_write(self.path, f'{{"same": [{lines(same)}\n],\n"rows": [{lines(rows)}\n]}}\n'.encode())


@cache
def code_digest(root: Path, *, mcmc: bool) -> str:
    """Digest of the code in the folders CODE, without comments, docstrings and empty lines.

    On one device, code of equal digests trains models of the same bytes. Code of other digests may do so too.
    mcmc: False to leave out ONLY_MCMC.
    """
    digest = hashlib.blake2b(digest_size=8)
    for folder in CODE:
        for path in sorted((root / folder).rglob("*")):
            name = path.relative_to(root).as_posix()
            if path.suffix in (".py", ".cl", ".h") and (mcmc or name != ONLY_MCMC):
                digest.update(f"{name}\0{_bare(path)}\0".encode())
    return digest.hexdigest()


def _bare(path: Path) -> str:
    text = path.read_text("utf-8")
    return bare_python(text) if path.suffix == ".py" else " ".join(COMMENT.sub(" ", text).split())


def bare_python(text: str) -> str:
    """Source text without comments, docstrings and empty lines. Unlike the result of `ast.unparse`, it is the same in
    every version of Python."""
    lines = [f"{line}\n" for line in text.split("\n")]
    starts = list(accumulate(map(len, lines), initial=0))
    spans = []
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        blank = token.type == tokenize.NL and not lines[token.start[0] - 1].strip()
        if blank or token.type == tokenize.COMMENT:
            spans.append((starts[token.start[0] - 1] + token.start[1], starts[token.end[0] - 1] + token.end[1]))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            last = (node.end_lineno or node.lineno, node.end_col_offset)
            ends = ((node.lineno, node.col_offset), last)
            begin, end = (starts[line - 1] + len(lines[line - 1].encode()[:column].decode()) for line, column in ends)
            spans.append((begin, end))
    text = "".join(lines)
    for begin, end in sorted(spans, reverse=True):
        before, after = text[:begin].rstrip(" "), text[end:]
        alone = not before or before.endswith("\n")
        text = before + (after.removeprefix("\n") if alone else after)
    return text.rstrip("\n")


def device_of(run: Path) -> str:
    """Names of the device and the driver that the training ran on."""
    with (run / "metrics.jsonl").open(encoding="utf-8") as lines:
        session = json.loads(lines.readline())["session"]
    return f"{session['device']}, {session['driver'].split('  ')[0]}"
