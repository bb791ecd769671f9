# SPDX-License-Identifier: Apache-2.0
"""OpenCL devices, their memory, the kernels built for them, and launches; nothing here knows of Gaussians."""

import os

# This variable switches off pyopencl's own cache of builds, and is read at the import. Drivers already cache builds by
# the whole source text. pyopencl's cache needs a writable home folder, and some drivers fail to load its binaries.
os.environ.setdefault("PYOPENCL_NO_CACHE", "1")

from clsplat.device.drivers import quirks
from clsplat.process import undisturbed

# the next three calls set environment variables that a driver reads when it is loaded
quirks.make_cache_folder()
quirks.pin_threads()
quirks.offer_packaged()
with undisturbed():  # an exception in a signal handler during the import would abort the process
    import pyopencl as cl

__all__ = ["cl"]
