# SPDX-License-Identifier: Apache-2.0
"""The demo: training on a synthetic scene."""
