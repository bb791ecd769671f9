# SPDX-License-Identifier: Apache-2.0
"""The self-test, which checks if the results of a driver can be trusted."""
