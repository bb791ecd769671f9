# SPDX-License-Identifier: Apache-2.0
"""Reference implementations ("twins") of the OpenCL stages in float64 NumPy, for tests, self-test and benchmark."""
