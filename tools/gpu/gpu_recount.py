# SPDX-License-Identifier: Apache-2.0
"""Count the model's inputs of measured steps, in the code that was measured.

The code is taken from the repository's history. Its own `gpu_variants.py` records its launches, and its kernels are
compiled and counted by the present tools, with the rules of `gpu_rules_measured.py`. So measured and present kernels
are always counted alike.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

from gpu_compilers import TEXTS, ask_package
from gpu_devices import GPUS

from clsplat.errors import ClsplatError

ROOT = Path(__file__).resolve().parents[2]
_TELL_TEXTS = "import json, sys; from clsplat.device.program import text_of; "
_TELL_TEXTS += "print(json.dumps({stem: text_of(stem) for stem in sys.argv[1:]}))"

Count = Callable[[Sequence[Mapping[str, Any]], str, Mapping[str, Any]], list[Any]]
"""The inputs of launches for a target, with a frame's counts."""


def older_code(commit: str, folder: Path) -> None:
    """Write package, kernels and tools of a commit to a folder. Raises ClsplatError if the history lacks it."""
    done = subprocess.run(
        ["git", "-C", str(ROOT), "archive", commit, "clsplat", "kernels", "tools"], capture_output=True, check=False
    )
    if done.returncode:
        last = (done.stderr.decode(errors="replace").strip().splitlines() or ["nothing"])[-1]
        raise ClsplatError(
            f"commit {commit} of docs/gpus/calibration.json: git archive says `{last}`, expected a whole clone"
        )
    with tarfile.open(fileobj=BytesIO(done.stdout)) as archive:
        archive.extraction_filter = getattr(tarfile, "data_filter", None)  # Python 3.11.3 and older have none
        archive.extractall(folder)  # noqa: S202  # an archive of our own files


def launches_in(folder: Path, commit: str, shape: str, frames: Sequence[Mapping[str, Any]]) -> list[Any]:
    """Launches of each frame by the code of a commit, which is in a folder. Adds the kernels' texts to TEXTS."""
    steps = ask_package(shape, frames, folder / "tools/gpu")
    stems = sorted({launch["stem"] for step in steps for launch in step if "stem" in launch})
    done = subprocess.run(
        [sys.executable, "-c", _TELL_TEXTS, *stems], cwd=folder, capture_output=True, text=True, check=True
    )
    TEXTS.update({(commit, stem): text for stem, text in json.loads(done.stdout).items()})
    return [[{**launch, "commit": commit} if "stem" in launch else launch for launch in step] for step in steps]


def recount(rows: Sequence[dict[str, Any]], frames: Sequence[Mapping[str, Any]], count: Count) -> None:
    """Set the `inputs` of all scenes that have a frame to those of the code that was measured.

    A row's code is that of `commit`, or of `counted` if the tools of its own commit record no launches. A scene's
    `counts` replace those of its frame, where the measured kernels divided tiles differently.
    rows: of calibration.json; changed in place.
    """
    by_name = {frame["name"]: frame for frame in frames}
    for row in rows:
        target = next((each.target for each in GPUS if each.name == row.get("gpu")), "")
        scenes = [scene for scene in row["scenes"] if target and scene.get("frame") in by_name]
        commit = row.get("counted", row["commit"])
        given = {scene["scene"]: {**by_name[scene["frame"]], **scene.get("counts", {})} for scene in scenes}
        with tempfile.TemporaryDirectory(prefix="clsplat-gpu-") as folder:
            older_code(commit, Path(folder))
            steps = launches_in(Path(folder), commit, row["shape"], list(given.values()))
        for scene, step, frame in zip(scenes, steps, given.values(), strict=True):
            scene["inputs"] = count(step, target, frame)
