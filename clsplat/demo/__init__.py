# SPDX-License-Identifier: Apache-2.0
"""The demo, on a synthetic scene."""
