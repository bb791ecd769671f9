# SPDX-License-Identifier: Apache-2.0
"""Detection of network file systems, such as NFS, and measurement of their transfer rates."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from pathlib import Path

from clsplat.errors import amount

MOUNTS = Path("/proc/mounts")
"""Linux's list of mounted file systems. Other systems do not have this file."""
NETWORK_SAMPLE_BYTES = 16 << 20
"""Bytes that are read or written before the rate of a network disk is reported."""
NETWORK_TYPES = ("nfs", "nfs4", "cifs", "smb3", "fuse.sshfs", "9p")


def network_type(folder: Path) -> str:
    """Type of the network file system that contains `folder`; "" if the file system is local or unknown."""
    with suppress(OSError, ValueError):
        real = os.path.realpath(folder)
        found = ("", "")
        for line in MOUNTS.read_text("utf-8", "surrogateescape").splitlines():
            _, place, kind, *_ = line.split(" ")
            place = re.sub(r"\\([0-7]{3})", lambda match: chr(int(match[1], 8)), place)
            below = place.rstrip("/") + "/"
            if (real + "/").startswith(below) and len(below) >= len(found[0]):
                found = (below, kind)
        return found[1] if found[1] in NETWORK_TYPES else ""
    return ""


class NetworkRate:
    """Measures the transfer rate of a folder, and reports it once if the folder is on a network disk.

    flag: command-line flag by which the user can choose another folder.
    """

    def __init__(self, folder: Path, flag: str) -> None:
        self._folder, self._flag = folder, flag
        self._network = network_type(folder)
        self._moved, self._seconds = 0, 0.0

    def count(self, nbytes: int, seconds: float) -> str:
        """Add bytes that were read or written in `seconds`. Returns a report for the user, or "" before it is due."""
        if not self._network:
            return ""
        self._moved += nbytes
        self._seconds += seconds
        if self._moved < NETWORK_SAMPLE_BYTES:
            return ""
        network, self._network = self._network, ""
        rate = amount(int(self._moved / max(self._seconds, 1e-6)))
        return (
            f"{self._folder}: is on a network disk ({network}), which moves {rate} a second; a local folder "
            f"({self._flag} DIR) may be faster"
        )
