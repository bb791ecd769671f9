# SPDX-License-Identifier: Apache-2.0
"""`python -m clsplat`, and the command `clsplat`: the command line, with Ctrl-C caught while that is being imported."""

from __future__ import annotations

import io
import sys


def main() -> int:
    """Run the command line in `sys.argv`; returns the exit status."""
    try:
        from clsplat.process import fill_closed_streams

        fill_closed_streams()
        output = sys.stdout
        if isinstance(output, io.TextIOWrapper) and output.errors == "strict":
            output.reconfigure(errors="backslashreplace")  # a path may have letters that the stream's encoding lacks
        from clsplat.cli import main as run

        return run()
    except KeyboardInterrupt:  # before the command line could catch it
        print("clsplat: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
