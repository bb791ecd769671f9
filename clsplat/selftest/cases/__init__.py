# SPDX-License-Identifier: Apache-2.0
"""Cases, which compare stages with their float64 twins, and the self-test's stages on the frozen scenes."""
