# SPDX-License-Identifier: Apache-2.0
"""Entry point of the command line, `clsplat` or `python -m clsplat`. It handles Ctrl-C even during imports."""

from __future__ import annotations

import io
import sys


def main() -> int:
    """Run the command line in `sys.argv`. Returns the exit status."""
    try:
        from clsplat.process import fill_closed_streams, terminable

        fill_closed_streams()
        output = sys.stdout
        if isinstance(output, io.TextIOWrapper) and output.errors == "strict":
            output.reconfigure(errors="backslashreplace")  # a path may have characters that the stream's encoding lacks

        with terminable():
            from clsplat.cli.main import main as run

            return run()
    except KeyboardInterrupt as error:  # Ctrl-C before the command line could catch it
        print("clsplat: interrupted", file=sys.stderr)
        return 128 + getattr(error, "number", 2)  # as in `process.status_of`, which may not be imported yet


if __name__ == "__main__":
    sys.exit(main())
