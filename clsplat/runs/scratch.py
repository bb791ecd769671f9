# SPDX-License-Identifier: Apache-2.0
"""A training's scratch files (--scratch): their names, which checkpoints need them, and the removal of other files."""

from __future__ import annotations

import hashlib
import os
import secrets
from contextlib import suppress
from pathlib import Path

from clsplat.chunks.manifest import Manifest
from clsplat.chunks.store import ChunkStore, KeptSlots
from clsplat.errors import warn
from clsplat.files.atomic import machine_mark, remove
from clsplat.files.mounts import NetworkRate
from clsplat.runs.run import OWNER_DIGITS, SCRATCH_SUFFIX, Run


def owner_of(run: Run | None) -> str:
    """Return the digits with which the names of a training's scratch files begin.

    run: run whose folder's path and inode are hashed to these digits; None hashes the machine and the process id.
    The inode tells two runs apart that have the same path, such as in two containers.
    """
    of = f"{run.path.resolve()} {run.path.stat().st_ino}" if run is not None else f"{machine_mark()} {os.getpid()}"
    return hashlib.sha256(of.encode("utf-8", "surrogatepass")).hexdigest()[:OWNER_DIGITS]


class ScratchFiles:
    """The scratch files of one training.

    folder: folder for new files, which other trainings may use too.
    owner: beginning of the files' names (`owner_of`).
    run: run whose checkpoints need files; None if the training writes no checkpoints.
    """

    def __init__(self, folder: Path, owner: str, run: Run | None) -> None:
        self.folder, self._owner, self._run = folder.absolute(), owner, run
        self._rate = NetworkRate(folder, "--scratch")
        self._named: set[Path] = set()
        """Files that checkpoints of this run have named; some may be in other folders."""

    def new_file(self) -> Path:
        """Return a new file's path. The file is not created."""
        return self.folder / f"{self._owner}-{secrets.token_hex(4)}{SCRATCH_SUFFIX}"

    def is_own(self, path: Path) -> bool:
        """True if only this training can need the file `path`: its name begins with `owner`, or it is in the run's
        scratch/."""
        inside = self._run is not None and path.parent == (self._run.path / "scratch").absolute()
        return path.name.startswith(self._owner) or inside

    def may_write(self, path: Path) -> bool:
        """True if this training may continue to write to `path`, a file in `folder` that no other training needs."""
        return self.is_own(path) and path.parent == self.folder

    def follow(self, store: ChunkStore) -> None:
        """Protect the slots in the store's file that checkpoints need. From now on, also warn if `folder` is on a
        network disk."""
        assert store.path is not None
        path = store.path
        store.release, store.file.moved = lambda: self._release(path), self._count
        store.has_checkpoints = self._run is not None
        store.slots.hold(self._kept(path))

    def saved(self, store: ChunkStore | None) -> None:
        """Protect the slots that the new checkpoint names, and remove files that no checkpoint names.

        store: the store of the model; None if the model is not in a scratch file.
        """
        current = None if store is None else store.path
        if store is not None and current is not None:
            store.hold(self._kept(current))
        self.remove_unnamed(current)

    def remove_unnamed(self, current: Path | None = None) -> None:
        """Remove this training's scratch files that no checkpoint names, such as those of a process that was killed.

        current: file that is in use, and stays.
        """
        own = set(self.folder.glob(f"{self._owner}-*{SCRATCH_SUFFIX}")) | set(filter(self.is_own, self._named))
        if not own - {current}:
            return
        try:
            named = {manifest.path for _, manifest in self._manifests()}
        except OSError:  # a checkpoint that cannot be read now may need any of the files
            return
        for path in own - named - {current}:
            with suppress(OSError):
                remove(path)
            self._named.discard(path)

    def _manifests(self) -> list[tuple[Path, Manifest]]:
        found = self._run.manifests() if self._run is not None else []
        self._named.update(manifest.path for _, manifest in found)
        return found

    def _kept(self, path: Path) -> KeptSlots:
        return [manifest.slots for _, manifest in self._manifests() if manifest.path == path]

    def _release(self, path: Path) -> KeptSlots | None:
        return self._kept(path) if self._run is not None and self._run.give_up_checkpoint() else None

    def _count(self, nbytes: int, seconds: float) -> None:
        if note := self._rate.count(nbytes, seconds):
            warn(note)
