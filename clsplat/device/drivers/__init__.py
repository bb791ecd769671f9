# SPDX-License-Identifier: Apache-2.0
"""OpenCL drivers: their names, faults, capabilities and use after a fork, and the record of their test results."""
