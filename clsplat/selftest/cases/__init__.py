# SPDX-License-Identifier: Apache-2.0
"""Cases of stages beside their float64 twins, and the self-test's stages on the frozen scenes."""
