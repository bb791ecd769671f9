# SPDX-License-Identifier: Apache-2.0
"""OpenCL devices, their memory, the kernels built for them, and launches; nothing here knows of Gaussians."""

import os

# Switches pyopencl's own cache off, so it is set before the import. Drivers already cache their builds by the whole
# source text. A second cache needs a writable home, and some drivers fail to load its binaries.
os.environ.setdefault("PYOPENCL_NO_CACHE", "1")

from clsplat.device.drivers import quirks
from clsplat.process import undisturbed

# must come before a driver is loaded
quirks.make_cache_folder()
quirks.pin_threads()
quirks.offer_packaged()
with undisturbed():  # an exception in a signal handler during the import would abort the process
    import pyopencl as cl  # imported here once; other modules use this name

__all__ = ["cl"]
