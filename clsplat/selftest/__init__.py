# SPDX-License-Identifier: Apache-2.0
"""The self-test, which finds out if a driver can be trusted."""
