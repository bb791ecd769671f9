# SPDX-License-Identifier: Apache-2.0
"""Cases of the self-test: each runs stages on a frozen scene, and compares the results with those of their float64
twins."""
