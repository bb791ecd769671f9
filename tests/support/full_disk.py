# SPDX-License-Identifier: Apache-2.0
"""Disks that are full for real: small file systems of memory, which a process mounts in a namespace of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from calls import ended

MOUNT = 'mkdir -p "$1" && mount -t tmpfs -o size="$2" none "$1" && shift 2 && exec "$@"'


@cache
def can_mount() -> bool:
    """True if this user may mount a file system of memory in a namespace of its own."""
    words = ["unshare", "-rm", "sh", "-c", MOUNT, "sh", "/tmp", "64k", "true"]
    try:
        return subprocess.run(words, capture_output=True, check=False, timeout=20).returncode == 0
    except OSError:
        return False


mounts = pytest.mark.skipif(not can_mount(), reason="this user may not mount a file system")


def on_disk(folder: Path, size: str, code: str, *words: str, **variables: str) -> list[str]:
    """The lines that Python code prints where `folder` is a disk of that size. words: arguments of the code."""
    command = ["unshare", "-rm", "sh", "-c", MOUNT, "sh", folder, size, sys.executable, "-c", code, *words]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **variables}
    done = ended(*command, timeout=120, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()
