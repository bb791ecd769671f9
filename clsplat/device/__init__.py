# SPDX-License-Identifier: Apache-2.0
"""OpenCL: devices, their memory, and kernels built for them."""

from clsplat.device import driver_cache, packaged
from clsplat.process import undisturbed

# before a driver is loaded
driver_cache.make_room()
packaged.offer()
with undisturbed():  # an exception of a signal's handler while it is imported would abort the process
    import pyopencl  # noqa: F401  # for all that follow
