# SPDX-License-Identifier: Apache-2.0
"""Camera models, each defined by its float64 formulas. `clsplat.camera` has the table of models."""
