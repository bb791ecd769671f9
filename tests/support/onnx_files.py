# SPDX-License-Identifier: Apache-2.0
"""ONNX networks written byte by byte, without the package onnx: a detector of corners with the interface of ALIKED."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FLOAT, INT64 = 1, 7
PATCH, STEP = 15, 2
"""Side of a feature's patch in pixels, and distance of its samples."""
MOST = 500
"""Number of features of a picture."""


def _varint(value: int) -> bytes:
    value &= (1 << 64) - 1
    data = bytearray()
    while True:
        data.append((value & 0x7F) | (0x80 if value > 0x7F else 0))
        value >>= 7
        if not value:
            return bytes(data)


def _field(number: int, value: int | str | bytes) -> bytes:
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    data = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | 2) + _varint(len(data)) + data


def _tensor(name: str, values: NDArray[Any]) -> bytes:
    kind = FLOAT if values.dtype == np.float32 else INT64
    dims = b"".join(_field(1, side) for side in values.shape)
    return dims + _field(2, kind) + _field(8, name) + _field(9, values.tobytes())


def _attribute(name: str, value: int | str | list[int]) -> bytes:
    head = _field(1, name)
    if isinstance(value, str):
        return head + _field(4, value) + _field(20, 3)
    if isinstance(value, int):
        return head + _field(3, value) + _field(20, 2)
    return head + b"".join(_field(8, each) for each in value) + _field(20, 7)


def _node(kind: str, inputs: str, outputs: str, **attributes: int | str | list[int]) -> bytes:
    names = b"".join(_field(1, name) for name in inputs.split()) + b"".join(_field(2, name) for name in outputs.split())
    return names + _field(4, kind) + b"".join(_field(5, _attribute(name, each)) for name, each in attributes.items())


def _value(name: str, kind: int, shape: tuple[int | str, ...]) -> bytes:
    dims = b"".join(_field(1, _field(1, side) if isinstance(side, int) else _field(2, side)) for side in shape)
    return _field(1, name) + _field(2, _field(1, _field(1, kind) + _field(2, dims)))


def write_network(
    path: Path, nodes: list[bytes], inputs: list[bytes], outputs: list[bytes], constants: dict[str, NDArray[Any]]
) -> None:
    """Write a network of operators of opset 13."""
    graph = b"".join(_field(1, node) for node in nodes) + _field(2, "made")
    graph += b"".join(_field(5, _tensor(name, np.asarray(values))) for name, values in constants.items())
    graph += b"".join(_field(11, each) for each in inputs) + b"".join(_field(12, each) for each in outputs)
    path.write_bytes(_field(1, 8) + _field(7, graph) + _field(8, _field(2, 13)))


def write_other_network(path: Path) -> None:
    """Write a network that doubles a number."""
    write_network(path, [_node("Add", "a a", "b")], [_value("a", FLOAT, (1,))], [_value("b", FLOAT, (1,))], {})


def write_corners(path: Path, broken: bool = False) -> None:
    """Write a network with the inputs and outputs of ALIKED. Its features are blobs, its descriptors their patches.

    broken: the keypoints have a shape that fails with pictures.
    """
    row, column = np.mgrid[-4:5, -4:5]
    apart = row**2 + column**2
    blob = sum(sign * np.exp(-apart / (2 * width**2)) / width**2 for sign, width in ((1, 1.0), (-1, 1.6)))
    places = [(y, x) for y in range(0, PATCH, STEP) for x in range(0, PATCH, STEP)]
    patches = np.full((len(places), 1, PATCH, PATCH), -1 / PATCH**2, np.float32)  # the mean is subtracted
    for index, place in enumerate(places):
        patches[(index, 0, *place)] += 1
    constants = {
        "blob": (blob - blob.mean()).astype(np.float32)[None, None],
        "patches": patches,
        "around4": np.array([0, 0, 4, 4, 0, 0, 4, 4]),
        "around7": np.array([0, 0, 7, 7, 0, 0, 7, 7]),
        "flat": np.array([1, -1]),
        "planes": np.array([len(places), -1]),
        "one": np.array([1]),
        "most": np.array([MOST]),
        "two": np.array([2.0], np.float32),
        "onef": np.array([1.0], np.float32),
        "height": np.array([2]),
        "width": np.array([3]),
        "line": np.array([3, -1]) if broken else np.array([-1]),
        "column": np.array([-1, 1]),
    }
    nodes = [
        _node("ReduceMean", "image", "grey", axes=[1], keepdims=1),
        _node("Pad", "grey around4", "grey4", mode="edge"),
        _node("Conv", "grey4 blob", "signed"),
        _node("Abs", "signed", "strength"),
        _node("MaxPool", "strength", "peak", kernel_shape=[5, 5], pads=[2, 2, 2, 2], strides=[1, 1]),
        _node("Equal", "strength peak", "is_peak"),
        _node("Cast", "is_peak", "peaks", to=FLOAT),
        _node("Mul", "strength peaks", "score"),
        _node("Reshape", "score flat", "line_of_scores"),
        _node("Reshape", "max_keypoints one", "asked"),
        _node("Min", "asked most", "count"),
        _node("TopK", "line_of_scores count", "scores chosen", axis=1),
        _node("Shape", "image", "shape"),
        _node("Gather", "shape width", "across"),
        _node("Gather", "shape height", "down"),
        _node("Reshape", "chosen line", "at"),
        _node("Div", "at across", "row"),
        _node("Mod", "at across", "column_at"),
        *_normalised("column_at", "across", "x"),
        *_normalised("row", "down", "y"),
        _node("Concat", "x_column y_column", "xy", axis=1),
        _node("Unsqueeze", "xy zero", "keypoints"),
        _node("Pad", "grey around7", "grey7", mode="edge"),
        _node("Conv", "grey7 patches", "all_patches"),
        _node("Reshape", "all_patches planes", "rows"),
        _node("Gather", "rows at", "taken", axis=1),
        _node("Transpose", "taken", "turned", perm=[1, 0]),
        _node("Unsqueeze", "turned zero", "descriptors"),
    ]
    constants["zero"] = np.array([0])
    inputs = [
        _value("image", FLOAT, (1, 3, "h", "w")),
        _value("max_keypoints", INT64, ()),
        _value("min_score", FLOAT, ()),
    ]
    outputs = [
        _value("keypoints", FLOAT, (1, "k", 2)),
        _value("descriptors", FLOAT, (1, "k", len(places))),
        _value("scores", FLOAT, (1, "k")),
    ]
    write_network(path, nodes, inputs, outputs, constants)


def _normalised(index: str, size: str, name: str) -> list[bytes]:
    """Operators from the index of a pixel to a column of values from -1 to 1, between the outermost pixels' centres."""
    return [
        _node("Cast", index, f"{name}_f", to=FLOAT),
        _node("Cast", size, f"{name}_size", to=FLOAT),
        _node("Sub", f"{name}_size onef", f"{name}_last"),
        _node("Div", f"{name}_f {name}_last", f"{name}_part"),
        _node("Mul", f"{name}_part two", f"{name}_twice"),
        _node("Sub", f"{name}_twice onef", f"{name}_value"),
        _node("Reshape", f"{name}_value column", f"{name}_column"),
    ]
