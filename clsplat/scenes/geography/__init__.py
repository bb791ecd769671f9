# SPDX-License-Identifier: Apache-2.0
"""Places on the earth: the record of where a scene lies, and coordinates on the ellipsoid."""
