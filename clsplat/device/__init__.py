# SPDX-License-Identifier: Apache-2.0
"""OpenCL: devices, their memory, and kernels built for them."""

from clsplat.device import driver_cache, packaged

# before a driver is loaded
driver_cache.make_room()
packaged.offer()
