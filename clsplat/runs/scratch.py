# SPDX-License-Identifier: Apache-2.0
"""A training's files of chunks: their names, which checkpoints need them, and the removal of the others."""

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
    """The beginning of the names of a run's files, or of those of a training without a run.

    The folder's number (inode) tells a run from another that had its path, and was renamed or is in another container.
    """
    of = f"{run.path.resolve()} {run.path.stat().st_ino}" if run is not None else f"{machine_mark()} {os.getpid()}"
    return hashlib.sha256(of.encode("utf-8", "surrogatepass")).hexdigest()[:OWNER_DIGITS]


class ScratchFiles:
    """Files of chunks of one training.

    folder: folder of new files, which other trainings may use too.
    owner: beginning of the files' names.
    run: run with the checkpoints that name files; None if there are none.
    """

    def __init__(self, folder: Path, owner: str, run: Run | None) -> None:
        self.folder, self._owner, self._run = folder.absolute(), owner, run
        self._rate = NetworkRate(folder, "--scratch")
        self._named: set[Path] = set()
        """Files that checkpoints have named, also in other folders."""

    def new_file(self) -> Path:
        """Name of a new file."""
        return self.folder / f"{self._owner}-{secrets.token_hex(4)}{SCRATCH_SUFFIX}"

    def is_own(self, path: Path) -> bool:
        """True for a file that no other run needs."""
        inside = self._run is not None and path.parent == (self._run.path / "scratch").absolute()
        return path.name.startswith(self._owner) or inside

    def may_write(self, path: Path) -> bool:
        """True for a file in which this training can go on."""
        return self.is_own(path) and path.parent == self.folder

    def follow(self, store: ChunkStore) -> None:
        """Keep the slots of a file that checkpoints name, from now on. Tell the rate of a network disk."""
        assert store.path is not None
        path = store.path
        store.release, store.file.moved = lambda: self._release(path), self._count
        store.slots.hold(self._kept(path))

    def saved(self, store: ChunkStore | None) -> None:
        """Note that a checkpoint has been written, of the chunks in a file or of others."""
        current = None if store is None else store.path
        if store is not None and current is not None:
            store.hold(self._kept(current))
        self.remove_unnamed(current)

    def remove_unnamed(self, current: Path | None = None) -> None:
        """Remove this training's files that no checkpoint names, such as those of a process that was killed.

        current: file that stays.
        """
        own = set(self.folder.glob(f"{self._owner}-*{SCRATCH_SUFFIX}")) | set(filter(self.is_own, self._named))
        if not own - {current}:
            return
        named = {manifest.path for _, manifest in self._manifests()}
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
