# SPDX-License-Identifier: Apache-2.0
"""`python -m clsplat` is `clsplat`."""

import sys

from clsplat.cli import main

if __name__ == "__main__":
    sys.exit(main())
