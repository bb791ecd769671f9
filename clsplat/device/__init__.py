# SPDX-License-Identifier: Apache-2.0
"""OpenCL devices, their memory, the kernels built for them, and launches; nothing here knows of Gaussians."""

import os

# Set before pyopencl is imported: it switches pyopencl's own cache off. Drivers cache their builds by the whole source
# text. A second cache only adds binaries that some drivers fail to load again, and needs a writable home.
os.environ.setdefault("PYOPENCL_NO_CACHE", "1")

from clsplat.device.drivers import quirks
from clsplat.process import undisturbed

# before a driver is loaded
quirks.make_cache_folder()
quirks.pin_threads()
quirks.offer_packaged()
with undisturbed():  # an exception in a signal handler during the import would abort the process
    import pyopencl as cl  # imported here once; other modules use this name

__all__ = ["cl"]
