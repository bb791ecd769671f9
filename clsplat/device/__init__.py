# SPDX-License-Identifier: Apache-2.0
"""OpenCL: devices, their memory, and kernels built for them."""

import os

# Before pyopencl is imported. Drivers cache what they build, keyed by the whole text that they get; a second cache in
# front of theirs only adds binaries that some of them fail to load again, and wants a home that can be written.
os.environ.setdefault("PYOPENCL_NO_CACHE", "1")

from clsplat.device import quirks
from clsplat.process import undisturbed

# before a driver is loaded
quirks.make_cache_folder()
quirks.pin_threads()
quirks.offer_packaged()
with undisturbed():  # an exception of a signal's handler while it is imported would abort the process
    import pyopencl as cl  # for all that follow

__all__ = ["cl"]
