# SPDX-License-Identifier: Apache-2.0
"""Records of a block's or a finish's training: begun.json from its first moment on, done.json once it has finished."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from clsplat.blocks.plan import BLOCKS_FOLDER, COARSE_FOLDER, PLAN_FILE
from clsplat.errors import InputError
from clsplat.files.atomic import atomic_write
from clsplat.files.documents import digest, load_document
from clsplat.report import PLAN_PICTURE_FILE
from clsplat.runs.run import Run

BEGUN_FILE, DONE_FILE = "begun.json", "done.json"
"""Names of the records in a run's folder: of the start of a training, and of its end."""
MERGED_FILE, MERGED_APPEARANCE_FOLDER, JOBS_FOLDER = "merged.ply", "merged", "jobs"
"""Names of the merged model, of the folder with the photographs' merged appearance, and of the folder for claims and
logs of tasks, in a city's folder."""
CITY_FILES = frozenset(
    {
        *(PLAN_FILE, PLAN_PICTURE_FILE, COARSE_FOLDER, BLOCKS_FOLDER, MERGED_FILE, MERGED_APPEARANCE_FOLDER),
        *(JOBS_FOLDER, BEGUN_FILE, DONE_FILE),
    }
)
"""Names of files and folders in a city's folder, beside those of the run that is the finish."""
RECORD_FORM = 2
"""Number of the form of these records. In form 1, blocks did not train their appearances."""
_EXPECTED_RECORD = "a record that clsplat blocks wrote"


@dataclass(frozen=True)
class DoneRecord:
    """The end of a training.

    plan: digest of the plan (`BlockPlan.digest`).
    start: SHA-256 of the model that the training began with.
    files: SHA-256 of each file of the result (`Run.result_files`), by its name.
    """

    plan: str
    start: str
    files: Mapping[str, str]

    @property
    def result(self) -> str:
        """SHA-256 of the result: of the names and the digests of its files."""
        return hashlib.sha256("\n".join(f"{name} {known}" for name, known in self.files.items()).encode()).hexdigest()


def check_begun(run: Path, plan: str, start: str, advice: Callable[[], str]) -> None:
    """Record that a training begins in the folder `run`, or check that it began like this.

    plan, start: as for `DoneRecord`.
    advice: function that returns in words how to train anew, for the message.
    Raises InputError if the training in the folder began by another plan, or with another model.
    """
    path = run / BEGUN_FILE
    if not path.exists():
        run.mkdir(parents=True, exist_ok=True)
        content = {"clsplat_block": RECORD_FORM, "plan": plan, "start": start}
        atomic_write(path, (json.dumps(content) + "\n").encode())
        return
    record = _loaded(path, advice)
    for name, now, what in (("plan", plan, "by another plan"), ("start", start, "with another model")):
        if record.get(name) != now:
            raise InputError(
                f"{run}: its training began {what} ({name} {str(record.get(name))[:12]}, now {now[:12]}); {advice()}"
            )


def keep_done(run: Run, plan: str, start: str) -> None:
    """Write done.json for a finished training. plan, start: as for `DoneRecord`."""
    record = DoneRecord(plan, start, {file.name: digest(file) for file in run.result_files})
    atomic_write(run.path / DONE_FILE, (json.dumps({"clsplat_block": RECORD_FORM, **asdict(record)}) + "\n").encode())


def done_record(run: Path) -> DoneRecord | None:
    """Return the record of a finished training; None if it has not finished, or a file of its result is missing.

    Raises InputError for a damaged record.
    """
    path = run / DONE_FILE
    if not path.exists():
        return None
    record = _loaded(path, lambda: f"move {run} away to train anew")
    files = record.get("files")
    digests = files if isinstance(files, dict) else {}
    texts = [record.get("plan"), record.get("start"), digests.get("model.ply"), *digests.values()]
    if not all(isinstance(text, str) for text in texts):
        raise InputError(f"{path}: is damaged, expected {_EXPECTED_RECORD}; remove it, and train the block again")
    if not all((run / name).exists() for name in digests):
        return None
    return DoneRecord(str(record["plan"]), str(record["start"]), digests)


def _loaded(path: Path, advice: Callable[[], str]) -> dict[str, Any]:
    """Return the content of a record. Raises InputError for a file that is no record, or of another form.

    advice: function that returns in words how to train anew, for the message.
    """
    record = load_document(path, _EXPECTED_RECORD, "clsplat_block")
    if (form := record.get("clsplat_block")) != RECORD_FORM:
        raise InputError(
            f"{path}: clsplat_block is {form!r:.40}, expected {RECORD_FORM}: another version of clsplat began this "
            f"training; finish with that version, or {advice()}"
        )
    return record


def is_done(run: Path, plan: str, start: str | None = None) -> bool:
    """True if the training in the folder `run` has finished by this plan, and with this start unless it is None.

    plan, start: as for `DoneRecord`.
    """
    record = done_record(run)
    return record is not None and record.plan == plan and start in (None, record.start)
