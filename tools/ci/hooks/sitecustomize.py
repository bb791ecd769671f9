# SPDX-License-Identifier: Apache-2.0
"""Hooks for the interpreters of a pretended machine: this folder is put on PYTHONPATH by `tools/ci/machines.py`.

Python runs this file when it starts, and so in every process that a process of such a machine starts.
"""

from __future__ import annotations

import os
import sys

WITHOUT = "CLSPLAT_WITHOUT_PYPI_POCL"
"""Set to a folder without drivers: the PoCL that pip brings is not there. Its loader reads the folder .libs below
PYOPENCL_HOME, which pyopencl sets to its own when it is imported, wherever OCL_ICD_VENDORS points."""
INTERPRETER = "CLSPLAT_INTERPRETER"
"""Set to a script that runs Python: processes that Python starts by sys.executable go through it too. An emulator's
child would else be a process of the real processor."""


class _Hider:
    """Finds no module. Each part that pyopencl imports after it has set the variable is looked for here first."""

    @staticmethod
    def find_spec(name: str, *_: object) -> None:
        if name.startswith("pyopencl."):
            os.environ["PYOPENCL_HOME"] = os.environ[WITHOUT]


if os.environ.get(WITHOUT):
    sys.meta_path.insert(0, _Hider)  # a finder needs no more than this
if os.environ.get(INTERPRETER):
    sys.executable = os.environ[INTERPRETER]
