# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C while modules are being imported: one line and exit status 130, as at any other time."""

from __future__ import annotations

import pytest
from calls import python

INTERRUPTED = """
import runpy, sys

class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            raise KeyboardInterrupt

sys.meta_path.insert(0, Interrupt())
sys.argv = ["clsplat", "devices"]
{start}
"""
STARTS = {
    "python -m clsplat": "runpy.run_module('clsplat', run_name='__main__', alter_sys=True)",
    "clsplat": "from clsplat.__main__ import main; sys.exit(main())",
}


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize(
    "module", ["clsplat.cli.main", "tyro", "clsplat.cli.options", "clsplat.cli.devices", "pyopencl"]
)
def test_ctrl_c_during_an_import(start: str, module: str) -> None:
    code = INTERRUPTED.format(module=module, start=STARTS[start])
    done = python("-c", code, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "clsplat: interrupted\n")
