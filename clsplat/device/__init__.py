# SPDX-License-Identifier: Apache-2.0
"""OpenCL devices and drivers, device memory, kernel builds and launches. No module here depends on Gaussians."""

import os

# PYOPENCL_NO_CACHE switches off pyopencl's own cache of builds; pyopencl reads it at its import. Most drivers have a
# cache. pyopencl's cache needs a writable home folder, and some drivers fail to load binaries from it.
os.environ.setdefault("PYOPENCL_NO_CACHE", "1")

from clsplat.device.drivers import quirks
from clsplat.process import undisturbed

# the next three calls set environment variables that a driver reads when it is loaded
quirks.make_cache_folder()
quirks.pin_threads()
quirks.offer_packaged()
with undisturbed():  # a signal handler that raises during this import would abort the process
    import pyopencl as cl

__all__ = ["cl"]
