# SPDX-License-Identifier: Apache-2.0
"""The output folder of a capture: its files, and capture.json, which records the call and the input of each stage."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from clsplat.errors import InputError, examples
from clsplat.files.atomic import atomic_write, remove
from clsplat.files.documents import is_file, load_document
from clsplat.report import REPORT_FILE_NAME
from clsplat.runs.run import owned_files
from clsplat.scenes.sfm.captured_files import CAPTURE_RECORD_FILE
from clsplat.version import package_version


class CaptureFolder:
    """The output folder of a capture. Its attributes are the paths of the results.

    frames: name of the sub-folder with the frames or photographs that the first stage makes.
    """

    def __init__(self, path: Path, frames: str = "frames") -> None:
        self.path = path
        self.frames, self.scene, self.run = path / frames, path / "scene", path / "run"
        self.report, self.thumbnail = path / REPORT_FILE_NAME, path / "thumbnail.png"
        self.turntable = path / "turntable"
        self.record_path = path / CAPTURE_RECORD_FILE

    @property
    def results(self) -> dict[str, Path]:
        """Folder or file of each stage's results, in the order of the stages."""
        return {
            "frames": self.frames,
            "cameras": self.scene,
            "training": self.run,
            "report": self.report,
            "thumbnail": self.thumbnail,
            "turntable": self.turntable,
        }

    def asked(self) -> dict[str, Any]:
        """Return the input and settings of the call that made the folder; {} for a folder without capture.json."""
        return dict(self._read()["asked"]) if is_file(self.record_path) else {}

    def claim(self, asked: Mapping[str, Any], verb: str, *, overwrite: bool = False) -> None:
        """Record a call in capture.json. The folder must have no results, or be made by the same call.

        asked: input and settings of the call, as values for JSON.
        verb: command of the call, "capture" or "demo", for messages.
        overwrite: accept a folder that another call has made. If the call is the same, all results are made again.
        Raises InputError for a folder of another call, and for results that are not recorded in capture.json.
        """
        found = [path.name for path in self.results.values() if path.exists() or path.is_symlink()]
        if not is_file(self.record_path) or not found:
            if found:
                raise InputError(
                    f"{self.path}: holds {examples(found, len(found))}, which the {verb} did not create but would "
                    "replace; choose another folder, or remove them"
                )
            self._write(asked, {})
            return
        record = self._read()
        if record["asked"] != asked and not overwrite:
            changed = [key for key in {**record["asked"], **asked} if record["asked"].get(key) != asked.get(key)]
            was, now = (_told(each, changed) for each in (record["asked"], asked))
            more = ", or give --overwrite to replace it" if verb == "capture" else ""
            raise InputError(f"{self.path}: was made with {was}, not with {now}; choose another folder{more}")
        if overwrite:
            again = record["asked"] == asked
            self._write(asked, dict.fromkeys(record["made"], "") if again else record["made"])

    def begin(self, stage: str, source: str) -> None:
        """Remove the results of a stage unless they were made from `source`, a text that identifies the stage's input.

        capture.json records `source` before the stage makes its results. Raises InputError for results of a stage that
        capture.json does not record.
        """
        record, result = self._read(), self.results[stage]
        if stage not in record["made"] and (result.exists() or result.is_symlink()):
            raise InputError(f"{result}: was not made by this capture; choose another folder, or remove it")
        if record["made"].get(stage) != source:
            self._remove(stage)
            self._write(record["asked"], {**record["made"], stage: source})

    def _remove(self, stage: str) -> None:
        """Remove the results of a stage. In a run, files that clsplat did not write stay."""
        result = self.results[stage]
        if stage == "training":
            for file in owned_files(result):
                remove(file)
            for folder in sorted((path for path in result.rglob("*") if path.is_dir()), reverse=True):
                with suppress(OSError):  # fails for a folder that still has other files, which stays
                    folder.rmdir()
        elif result.is_dir() and not result.is_symlink():
            shutil.rmtree(result)
        else:
            remove(result)

    def _read(self) -> dict[str, Any]:
        document = load_document(self.record_path, "the record of a capture", "what was asked")
        record = {key: document.get(key) for key in ("asked", "made")}
        for key, value in record.items():
            if not isinstance(value, dict):
                raise InputError(
                    f"{self.record_path}: has no '{key}', expected the record of a capture; choose another folder"
                )
        return record

    def _write(self, asked: Mapping[str, Any], made: Mapping[str, str]) -> None:
        record = {"clsplat": package_version(), "asked": asked, "made": made}
        atomic_write(self.record_path, (json.dumps(record, indent=2) + "\n").encode())


def _told(asked: Mapping[str, Any], keys: list[str]) -> str:
    """Return text with the settings named in `keys` and their values. Settings that are None or missing are omitted."""
    values = {key: asked[key] for key in keys if asked.get(key) is not None}
    texts = {key: examples(value) if isinstance(value, list) else value for key, value in values.items()}
    return ", ".join(f"{key} {text}" for key, text in texts.items()) or f"no {keys[0]}"
