# SPDX-License-Identifier: Apache-2.0
"""Float64 twins of the stages in NumPy, short and slow, for tests, tools, the self-test and the benchmark."""
