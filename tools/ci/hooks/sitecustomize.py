# SPDX-License-Identifier: Apache-2.0
"""Hooks for the interpreters of a simulated machine. `tools/ci/machines.py` puts this folder on PYTHONPATH.

Python runs this file when it starts, in every process that such a machine starts.
"""

from __future__ import annotations

import os
import sys

WITHOUT = "CLSPLAT_WITHOUT_PYPI_POCL"
"""Variable with a folder without drivers, which hides PyPI's PoCL. PoCL's loader reads the folder .libs in
PYOPENCL_HOME, which pyopencl sets to its own folder when it is imported, whatever OCL_ICD_VENDORS is."""
INTERPRETER = "CLSPLAT_INTERPRETER"
"""Variable with a script that runs Python, for processes that Python starts through sys.executable. Without it, the
child of an emulator's process would run on the real processor."""


class _Hider:
    """An import hook that finds no module, but sets PYOPENCL_HOME anew.

    Python calls it for each part of pyopencl that is imported, which is after pyopencl has set the variable.
    """

    @staticmethod
    def find_spec(name: str, *_: object) -> None:
        if name.startswith("pyopencl."):
            os.environ["PYOPENCL_HOME"] = os.environ[WITHOUT]


if os.environ.get(WITHOUT):
    sys.meta_path.insert(0, _Hider)  # the class itself, as Python calls only `find_spec`
if os.environ.get(INTERPRETER):
    sys.executable = os.environ[INTERPRETER]
