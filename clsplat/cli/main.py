# SPDX-License-Identifier: Apache-2.0
"""The command line: from arguments to exit status.

Exit status: 0 for success, 1 if the work failed, 2 for a wrong call or input, 130 if interrupted by Ctrl-C.
After another signal the status is 128 plus the signal's number (docs/interruptions.md).
Errors are reported in one line on standard error; CLSPLAT_DEBUG=1 adds the traceback.
With --json, an error is also printed to standard output as an object with the keys "error" and "status".
"""

from __future__ import annotations

import contextlib
import os
import sys
import traceback
import warnings
from collections.abc import Sequence
from typing import Any, cast

from clsplat.cli.parsing import as_json, parse, report, run_function, tell
from clsplat.cli.session import Services
from clsplat.errors import ClsplatError, InputError, switched_on, system_trouble
from clsplat.process import reader_has_gone, status_of, terminable
from clsplat.version import package_version


def main(arguments: Sequence[str] | None = None, services: Services | None = None) -> int:
    """Run one command line, by default `sys.argv`. Returns the exit status.

    services: functions that do the work of the verbs. With None, they are imported from this package.
    """
    try:
        status = _run(list(sys.argv[1:] if arguments is None else arguments), services or Services())
        sys.stdout.flush()  # flush here: at exit the interpreter would print a traceback for a closed pipe
    except OSError as error:
        if not reader_has_gone(error):  # report an unwritable file, but not a pipe that its reader has closed
            tell(f"clsplat: error: standard output: {system_trouble(error)}")
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return status


def _run(arguments: list[str], services: Services) -> int:
    try:
        debug = switched_on("CLSPLAT_DEBUG")
    except InputError as error:
        tell(f"clsplat: error: {error}")
        return error.exit_status
    with warnings.catch_warnings():
        warnings.showwarning = cast("Any", _show_warning)
        if not debug:
            warnings.simplefilter("ignore")
        warnings.filterwarnings("always", category=UserWarning, module=r"clsplat\b|__main__")
        try:
            if arguments == ["--version"]:
                print(f"clsplat {package_version()}")
                return 0
            with terminable():
                verb = parse(arguments)
                return int(run_function(verb)(verb, services))
        except SystemExit as error:  # `parse` raises this after the help or after reporting a wrong call
            return error.code if isinstance(error.code, int) else 1
        except KeyboardInterrupt as error:
            if debug:
                traceback.print_exc()
            status = status_of(error)
            interrupted = " ".join(("interrupted", *map(str, error.args)))
            with contextlib.suppress(OSError):  # printing fails if the terminal is closed
                print(f"clsplat: {interrupted}", file=sys.stderr)
                if "--json" in arguments:
                    print(as_json(interrupted, status), flush=True)
            return status
        except (ClsplatError, OSError, MemoryError) as error:
            if isinstance(error, OSError) and reader_has_gone(error):
                raise
            if debug:
                traceback.print_exc()
            status = error.exit_status if isinstance(error, ClsplatError) else 1
            report(one_line(error), status, arguments)
            return status
        except Exception as error:
            if debug or not type(error).__module__.startswith("pyopencl"):
                raise
            report(f"the OpenCL driver failed: {one_line(error)}", 1, arguments)
            return 1


def one_line(error: BaseException) -> str:
    """Return the message of an error, joined into one line."""
    if isinstance(error, OSError) and not isinstance(error, ClsplatError):
        return system_trouble(error)
    if isinstance(error, MemoryError) and not isinstance(error, ClsplatError):
        return f"there is not enough main memory: {' '.join(str(error).split()) or 'the system has no more'}"
    return " ".join(str(error).split()) or type(error).__name__


def _show_warning(message: Warning | str, *_: Any) -> None:
    """Print a warning in one line, instead of `warnings.showwarning`, which adds the line of source code."""
    print(f"clsplat: warning: {' '.join(str(message).split())}", file=sys.stderr)
