# SPDX-License-Identifier: Apache-2.0
"""The cases, each a comparison of a stage with its float64 twin, and the list of the self-test's stages."""
