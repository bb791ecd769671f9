# SPDX-License-Identifier: Apache-2.0
"""Detection of network file systems."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from pathlib import Path

MOUNTS = Path("/proc/mounts")
"""Linux's list of mounted file systems. Other systems do not have this file."""
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
