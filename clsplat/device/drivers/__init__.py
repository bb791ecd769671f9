# SPDX-License-Identifier: Apache-2.0
"""OpenCL drivers: their names, faults and capabilities, and the record of their test results."""
