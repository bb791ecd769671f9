# SPDX-License-Identifier: Apache-2.0
"""OpenCL: devices, their memory, and kernels built for them."""

from clsplat.driver_cache import make_room

make_room()
