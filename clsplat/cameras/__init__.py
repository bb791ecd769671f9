# SPDX-License-Identifier: Apache-2.0
"""Camera models: the float64 formulas of each, which define it. `clsplat.camera` has their table."""
