# SPDX-License-Identifier: Apache-2.0
"""Entry point of `python -m clsplat.cli`, equal to `python -m clsplat`."""

from __future__ import annotations

import sys

if __name__ == "__main__":  # python -m clsplat.cli
    from clsplat.__main__ import main as whole

    sys.exit(whole())
