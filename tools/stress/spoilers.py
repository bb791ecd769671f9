# SPDX-License-Identifier: Apache-2.0
"""Ways to spoil a file (`hostile.py`): functions from its bytes and a random generator to other bytes."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import random
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

MOST_BYTES = 1 << 24
"""Size of a file in bytes above which it is not spoilt further. Some spoilers make such files."""

NUMBERS = (
    *("0", "-1", "-0", "1", "2", "255", "256", "65536", "4294967295", "2147483648", "-2147483649", "1000000000"),
    *("18446744073709551615", "9223372036854775808", "9" * 400, "9" * 5000, "1e308", "1e999", "-1e999", "1e-320"),
    *("nan", "NaN", "inf", "-Infinity", "0x10", "1_000", "\u0663", "\uff11"),
    *("1.5", "1.", ".5", "+3", "1e", "", "-", "true"),
)
WORDS = (
    *("../../etc/passwd", "/etc/passwd", "images/../../../x.png", "..", ".", "./a.png", "a.png", "images//a.png", "~"),
    *("C:\\\\Windows\\\\x.png", "..\\\\..\\\\x.png", "//host/share/x.png", "/dev/zero", "/dev/stdin", "/proc/self/mem"),
    *("a\u0000b.png", "\u202egnp.a", "\ufeff", "\U0001f4a9.png", "e\u0301.png", "caf\u00e9.png"),
    *("x" * 300, "y/" * 3000, " ", ""),
    *("PINHOLE", "OPENCV", "EQUIRECTANGULAR", "FULL_OPENCV", "null", "[]", "{}", "list", "property list uchar int x"),
    *("element vertex 99999999999", "end_header", "\\ud800", "\\u0000", "%s%n", "{name}", "a\nb", "a\rb", "\x1b[31m"),
)
VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2, 3.5, -0.0, 1e308, -1e308, 1e-320, math.nan, math.inf, 10**30, 10**400, 2**63),
    *("", "a", "1", "nan", [], {}, [[]], [None], [1, 2, 3], [1, "a"], {"a": 1}, [1] * 1000, [[1, 2], [3]], [10**400]),
    *([[1, 0, 0, 0]] * 4, [[0] * 4] * 4, [["1"] * 4] * 4, [[math.nan] * 4] * 4, [[1e200] * 4] * 4, [[[1]] * 4] * 4),
)


def _flip(data: bytes, rng: random.Random) -> bytes:
    spoilt = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4, 16)) if spoilt else 0):
        # headers are short, but affect the reading most
        at = rng.randrange(min(len(spoilt), 64)) if rng.random() < 0.3 else rng.randrange(len(spoilt))
        spoilt[at] = rng.choice((spoilt[at] ^ (1 << rng.randrange(8)), 0, 255, rng.randrange(256)))
    return bytes(spoilt)


def _numbers(data: bytes, rng: random.Random) -> bytes:
    """Overwrite 2, 4 or 8 bytes with a number that may cause errors, in either byte order."""
    order, letter = rng.choice("<>"), rng.choice("hHiIqQfd")
    size = struct.calcsize(letter)
    if letter in "fd":
        value: float = rng.choice((math.nan, math.inf, -math.inf, 0.0, -0.0, 1e30, -1e30, 1e-40, 3e38))
    else:
        bits = 8 * size
        wide = rng.choice((0, 1, 2, (1 << bits) - 1, (1 << (bits - 1)) - 1, 1 << (bits - 1), 1 << (bits // 2), 100_000))
        value = wide % (1 << bits)
        value -= (1 << bits) if letter.islower() and value >= 1 << (bits - 1) else 0
    limit = max(len(data) - size + 1, 1)
    at = rng.randrange(min(limit, 128)) if rng.random() < 0.5 else rng.randrange(limit)
    if rng.random() < 0.7:
        at -= at % min(size, 4)
    return data[:at] + struct.pack(order + letter, value) + data[at + size :]


def _cut(data: bytes, rng: random.Random) -> tuple[int, int]:
    start = rng.randrange(len(data) + 1)
    return start, min(start + rng.choice((1, 1, 2, 4, 8, 24, 100)), len(data))


def _truncate(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.choice((0, 1, len(data) - 1, rng.randrange(len(data) + 1), rng.randrange(len(data) + 1)))]


def _insert(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.randbytes(rng.choice((1, 2, 4, 64))) + data[at:]


def _remove(data: bytes, rng: random.Random) -> bytes:
    start, stop = _cut(data, rng)
    return data[:start] + data[stop:]


def _repeat(data: bytes, rng: random.Random) -> bytes:
    start, stop = _cut(data, rng)
    return data[:stop] + data[start:stop] * rng.choice((1, 1, 2, 1000)) + data[stop:]


def _append(data: bytes, rng: random.Random) -> bytes:
    return data + rng.choice((b"\0", b"\n", b"x", b"\0" * 5000, data, rng.randbytes(100)))


def _zeros(data: bytes, rng: random.Random) -> bytes:
    start, stop = _cut(data, rng)
    return data[:start] + rng.choice((b"\0", b"\xff")) * (stop - start) + data[stop:]


def _swap(data: bytes, rng: random.Random) -> bytes:
    a, b = sorted((rng.randrange(len(data) + 1), rng.randrange(len(data) + 1)))
    return data[b:] + data[a:b] + data[:a]


def _words(data: bytes, rng: random.Random) -> bytes:
    """Replace one or two numbers or words by others."""
    text = data.decode("latin-1")
    found = list(re.finditer(r"-?[0-9][0-9.eE+-]*|[A-Za-z_./][\w./-]*", text))
    if not found:
        return data
    for match in sorted(rng.sample(found, min(rng.choice((1, 1, 2)), len(found))), key=lambda m: -m.start()):
        choice = rng.choice(NUMBERS if rng.random() < 0.6 else WORDS)
        text = text[: match.start()] + choice.encode("utf-8").decode("latin-1") + text[match.end() :]
    return text.encode("latin-1")


def _lines(data: bytes, rng: random.Random) -> bytes:
    """Remove, duplicate, exchange, empty or repeat a line."""
    lines = data.split(b"\n")
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    kind = rng.randrange(5)
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines.insert(other, lines[at])
    elif kind == 2:
        lines[at], lines[other] = lines[other], lines[at]
    elif kind == 3:
        lines[at] = b""
    else:
        lines = lines[:at] + [lines[at]] * min(1000, MOST_BYTES // (1 + len(lines[at]))) + lines[at:]
    return b"\n".join(lines)


def _text(data: bytes, rng: random.Random) -> bytes:
    """Change a text like an editor or a bad transfer, or make it deeply nested or very long."""
    at = rng.randrange(len(data) + 1)
    nested = b"[" * 5000 + b"]" * 5000, b"9" * 10_000, b"{a=" * 1000 + b"1" + b"}" * 1000

    def between(part: bytes) -> bytes:
        return data[:at] + part + data[at:]

    edits: tuple[Callable[[], bytes], ...] = (
        lambda: b"\xef\xbb\xbf" + data,
        lambda: data.replace(b"\n", b"\r\n"),
        lambda: data.replace(b"\n", b"\r"),
        lambda: data.decode("latin-1").encode("utf-16"),
        lambda: between(b"\xff\xfe\xc3"),
        lambda: between(rng.choice((b"[", b"{", b'{"a":', b"(")) * rng.choice((100, 3000, 100_000))),
        lambda: between(rng.choice((b"x", b" ", b"9", b"\t", b"0", b"#", b"a.")) * 1_000_000),
        lambda: between(rng.choice(WORDS).encode()),
        lambda: b"[" * 50_000 + b"]" * 50_000,
        lambda: data.replace(b" ", rng.choice((b"\0", b"\x0b", b"\xc2\xa0", b""))),
        lambda: b"x = " + rng.choice(nested),
    )
    return rng.choice(edits)()


def _json(data: bytes, rng: random.Random) -> bytes:
    """Replace a value of a JSON document, remove a key, or repeat a list."""
    try:
        first, _, rest = data.partition(b"\n") if data.count(b"\n{") else (data, b"", b"")
        document = json.loads(first)
    except (ValueError, RecursionError):
        return data
    nodes: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        pairs = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
        for key, value in pairs:
            nodes.append((node, key))
            walk(value)

    walk(document)
    if not nodes:
        return data
    node, key = rng.choice(nodes)
    kind = rng.randrange(6)
    if kind == 0 and isinstance(node, dict):
        del node[key]
    elif kind == 1 and isinstance(node, list):
        node.extend(list(node) * rng.choice((1, 50)))
    elif kind == 2:
        node[key] = rng.choice(WORDS)
    elif kind == 3:
        node[key] = [node[key]]
    else:
        node[key] = rng.choice(VALUES)
    try:
        return json.dumps(document).encode() + (b"\n" + rest if rest else b"")
    except (ValueError, RecursionError):
        return data


class _Mark:
    """An object whose pickle calls a function when it is loaded. So a reader that loads pickles is detected."""

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return (_unpickled, ("a pickle was loaded",))


def _unpickled(text: str) -> None:
    raise AssertionError(text)


def _archive(data: bytes, rng: random.Random) -> bytes:
    """Spoil a member of an archive, such as a checkpoint.

    It may claim a huge array, become a pickle, a decompression bomb or an invalid state, or get another name or number.
    Or all members are repeated.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [(info.filename, archive.read(info)) for info in archive.infolist()]
    except (zipfile.BadZipFile, zlib.error, OSError, ValueError, NotImplementedError, RuntimeError, EOFError):
        return data
    if not members:
        return data
    at = rng.randrange(len(members))
    name, content = members[at]
    kind = rng.randrange(9)
    compression = zipfile.ZIP_STORED
    if kind == 0:
        shape = rng.choice(((10**12,), (2**62, 4), (-1,), (0, 5), (3, 10**9), (), (1,) * 40, (10**400,)))
        content = _npy_claim(f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape!r}, }}", b"\0" * 48)
    elif kind == 1:
        content = npy(np.array([_Mark(), {}], object), allow_pickle=True)
    elif kind == 2:
        kinds = ("'|O'", "'<f9'", "'<V99999999'", "[('a', '<f4')]", "'<U1000000000'", "None", "'<c16'", "'<M8[s]'")
        content = _npy_claim(f"{{'descr': {rng.choice(kinds)}, 'fortran_order': False, 'shape': (4, 3), }}", b"\0" * 48)
    elif kind == 3:
        names = ("../../x.npy", "/etc/passwd", "parameters/means.npy", "state.json.npy", "x" * 70_000, "", "a")
        name = rng.choice(names)
    elif kind == 4:
        compression = zipfile.ZIP_DEFLATED
        content = npy(np.zeros(rng.choice((10, 15_000_000)), np.float32))
    elif kind == 5:
        name = "state.json.npy"
        texts = (b"", b"{", b"[" * 100_000, b"null", b"[]", b'{"step": 1e999, "state": {}}', b'{"step": "x"}')
        long = b'{"step": ' + b"9" * 6000 + b', "state": {}}'
        other = rng.choice((rng.choice(texts), b'{"step": NaN, "state": 3}', long, b'{"step": -5, "state": []}'))
        content = npy(np.frombuffer(other, np.uint8))
        members = [member for member in members if member[0] != name]
        at = 0
    elif kind == 6:
        content = _npy_claim("{'descr': " + "(" * rng.choice((50, 5000)) + "'<f4', 'fortran_order': False}", b"")
    elif kind == 7:
        content = _numbers(content, rng)
    else:
        times, size = rng.choice((2, 200)), sum(len(body) for _, body in members)
        members = members * (times if times * size <= 8 * MOST_BYTES else 2)
    if members:
        members[min(at, len(members) - 1)] = (name, content)
    if kind == 5:
        members.append((name, content))
    buffer = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(buffer, "w", compression) as archive:
        warnings.simplefilter("ignore")  # about duplicate names
        for each, body in members:
            archive.writestr(each[:65_000] or "empty", body)
    return buffer.getvalue()


def npy(array: Any, **options: Any) -> bytes:
    """The bytes of an array's .npy file."""
    buffer = io.BytesIO()
    np.save(buffer, array, **options)
    return buffer.getvalue()


def _npy_claim(header: str, body: bytes) -> bytes:
    encoded = header.encode() + b"\n"
    return b"\x93NUMPY\x02\x00" + struct.pack("<I", len(encoded)) + encoded + body


def spoil_place(path: Path, folder: Path, rng: random.Random) -> None:
    """Replace a file by a link, a folder, a pipe or a huge sparse file, or remove it and add links in a loop or a file
    with an odd name."""
    with contextlib.suppress(OSError):  # for names that exist already or are too long
        _replace(path, folder, rng)


def _replace(path: Path, folder: Path, rng: random.Random) -> None:
    kind = rng.randrange(8)
    path.unlink()
    if kind == 0:
        path.symlink_to(rng.choice(("/etc/passwd", "/dev/zero", "/dev/null", "/nonexistent", "/proc/self/mem", "/etc")))
    elif kind == 1:
        path.symlink_to(path.name)
    elif kind == 2:
        path.mkdir()
    elif kind == 3:
        os.mkfifo(path)
    elif kind == 4:
        for name in ("loop", "loop2", "loop3"):
            (path.parent / name).symlink_to(rng.choice((".", "..", str(folder))))
    elif kind == 5:
        path.symlink_to("../" * rng.randrange(1, 20) + "etc/passwd")
    elif kind == 6:
        odd = ("a\nb.png", "\x1b[31m.png", "\udcff.png", "e\u0301.png", "x" * 250 + ".png")
        (path.parent / rng.choice(odd)).write_bytes(b"")
    else:
        with open(path, "wb") as file:  # a sparse file, which takes no space on the disk
            file.truncate(rng.choice((1 << 20, 1 << 33)))


_BYTES = (_flip, _truncate, _numbers, _insert, _remove, _repeat, _append, _zeros, _swap)
_ALL = (*_BYTES, _words, _lines, _text, _json, _archive)
SPOILERS = {spoil.__name__.removeprefix("_"): spoil for spoil in _ALL}
