# SPDX-License-Identifier: Apache-2.0
"""`python -m clsplat`, and the command `clsplat`: the command line; signals are heard while that is imported."""

from __future__ import annotations

import io
import sys


def main() -> int:
    """Run the command line in `sys.argv`; returns the exit status."""
    try:
        from clsplat.process import fill_closed_streams, terminable

        fill_closed_streams()
        output = sys.stdout
        if isinstance(output, io.TextIOWrapper) and output.errors == "strict":
            output.reconfigure(errors="backslashreplace")  # a path may have letters that the stream's encoding lacks

        with terminable():
            from clsplat.cli.main import main as run

            return run()
    except KeyboardInterrupt as error:  # before the command line could catch it
        print("clsplat: interrupted", file=sys.stderr)
        return 128 + getattr(error, "number", 2)  # as `process.status_of`, which may not be there yet


if __name__ == "__main__":
    sys.exit(main())
