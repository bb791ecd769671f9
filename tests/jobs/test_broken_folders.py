# SPDX-License-Identifier: Apache-2.0
"""Jobs on a disk that is full for real, and in a folder that vanishes while tasks run. Both go on when it is mended."""

from __future__ import annotations

from pathlib import Path

import pytest
from calls import refuses
from counting import counted, counting_task
from full_disk import mounts, on_disk
from systems import posix

from clsplat.errors import ClsplatError
from clsplat.jobs import dispatcher
from clsplat.jobs.dispatcher import JobProgress, run_tasks
from clsplat.jobs.local_engine import LocalEngine

FULL = """
import sys
from pathlib import Path
from clsplat.errors import ClsplatError
from clsplat.jobs.dispatcher import run_tasks
from clsplat.jobs.local_engine import LocalEngine
from clsplat.jobs.task import JobTask
folder = Path(sys.argv[1])
code = "import sys; from pathlib import Path; from clsplat.files.atomic import atomic_write; "
code += "atomic_write(Path(sys.argv[1]), bytes(60000))"
tasks = [JobTask(name, (sys.executable, "-c", code, str(folder / name)), (folder / name).exists) for name in "abc"]
for _ in range(2):
    try:
        run_tasks(tasks, LocalEngine(1), folder / "jobs")
        print("done")
    except ClsplatError as error:
        print(error)
    (folder / "a").unlink(missing_ok=True)
    tasks = tasks[1:]
print(sorted(path.name for path in folder.iterdir()))
"""


@pytest.mark.slow
@mounts
def test_a_full_disk(tmp_path: Path) -> None:
    """The first two files fit. With the first removed, the third does too."""
    disk = tmp_path / "disk"
    first, *others = on_disk(disk, "160k", FULL, str(disk))
    assert f"WriteError: {disk / 'c'}: cannot be written: the disk is full: 59 KiB are needed and " in first
    assert first.endswith("; no worker is left for c; the same command goes on when that is mended")
    assert others == ["done", "['b', 'c', 'jobs']"]


@pytest.mark.slow
@posix
def test_a_folder_that_vanishes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As if a network disk were lost: one line, and the tasks go on when it is there again."""
    monkeypatch.setattr(dispatcher, "PROGRESS_SECONDS", 0.05)
    city, away = tmp_path / "city", tmp_path / "away"
    city.mkdir()
    tasks = [counting_task(city, name, 60, seconds=0.02) for name in "ab"]

    def lose(progress: JobProgress) -> None:
        if progress.steps > 20 and city.exists():
            city.rename(away)

    message = f"does not see {city / 'jobs'}, expected the same paths as on the dispatcher's machine; no worker is left"
    refuses(message, run_tasks, tasks, LocalEngine(2), city / "jobs", lose, error=ClsplatError)
    away.rename(city)
    before = [counted(city, name) for name in "ab"]
    assert sum(before) > 20
    run_tasks(tasks, LocalEngine(2), city / "jobs")
    assert [counted(city, name) for name in "ab"] == [60, 60]
    assert sorted(path.name for path in (city / "jobs").iterdir()) == ["a.log", "b.log", "mark"]
