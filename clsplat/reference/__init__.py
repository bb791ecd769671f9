# SPDX-License-Identifier: Apache-2.0
"""Float64 NumPy twins of the stages, short and slow: for tests, tools, the self-test and the bench."""
