# SPDX-License-Identifier: Apache-2.0
"""The table of a trial, as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from clsplat.progress import aligned

HEADER = ("kernel", "variant", "counted, M", "predicted, ms", "measured, ms", "ratio", "bits")


def table(record: Mapping[str, Any]) -> list[str]:
    """Lines with the results of a trial: limits, steps, kernels by variant, counters, peers, and parts left out.

    The column counted has millions of warp instructions in the code that clang and ptxas make. The column ratio has
    predicted by measured time.
    """
    commit = record["commit"] or "unknown"
    lines = [f"{record['device']}, {record['driver']}, {record['date']}, commit {commit}"]
    lines += record.get("nvidia_smi", [])
    limits: list[tuple[str, ...]] = [("limit", "value")]
    limits += ((name, f"{value:.4g}") for name, value in record["limits"].items())
    steps: list[tuple[str, ...]] = [("scene", "shape", "frame, ms", "step, ms", "step in a row, ms", "host, ms")]
    steps += [
        (
            row["frame"],
            row["shape"],
            *(f"{row[key]:.3f}" for key in ("frame_ms", "step_ms", "step_in_a_row_ms", "host_ms")),
        )
        for row in record["scenes"]
    ]
    counters: list[tuple[str, ...]] = [("scene", "kernel", "counter", "value")]
    counters += [(row["scene"], row["kernel"], *each) for row in record["counters"] for each in row["counted"].items()]
    peers: list[tuple[str, ...]] = [("scene", "program", "frame, ms", "step, ms", "loss")]
    peers += [
        (row["scene"], row["peer"], f"{row['frame_ms']:.3f}", f"{row['step_ms']:.3f}", row["loss"])
        for row in record["peers"]
    ]
    for rows in (limits, steps, counters, peers):
        lines += _part(rows)
    for scene in dict.fromkeys(row["scene"] for row in record["variants"]):
        rows = [_row(row) for row in record["variants"] if row["scene"] == scene]
        lines += ["", scene, *aligned([HEADER, *rows], left=(0, 1, 6))]
    by_reason: dict[str, list[str]] = {}
    for each in record["left_out"]:
        by_reason.setdefault(each["why"], []).append(each["what"])
    left_out = [f"left out, {why}: {'; '.join(what)}" for why, what in by_reason.items()]
    return [*lines, "", *(left_out or ["nothing was left out"])]


def _part(rows: Sequence[tuple[str, ...]]) -> list[str]:
    """Lines of a table of the rows; none if there is only the header."""
    return ["", *aligned(rows, left=range(len(rows[0])))] if len(rows) > 1 else []


def _row(row: Mapping[str, Any]) -> tuple[str, ...]:
    """A kernel's row. It has no prediction until the trial is completed."""
    predicted = row.get("predicted_ms")
    counted = "" if "counted" not in row else f"{row['counted']:.1f}"
    ratio = "" if predicted is None or not row["ms"] else f"{predicted / row['ms']:.2f}"
    name = row["kernel"] if row["kernel"] == row["stage"] else f"{row['stage']}: {row['kernel']}"
    told = "" if predicted is None else f"{predicted:.4f}"
    return (name, row["variant"], counted, told, f"{row['ms']:.4f}", ratio, row["bits"])
