# SPDX-License-Identifier: Apache-2.0
"""`rasterize_to_pixels`: images of splats from lists of tiles, by gsplat's call, with their gradient."""
