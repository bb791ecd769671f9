# SPDX-License-Identifier: Apache-2.0
"""The self-test: whether a driver is to be trusted."""
