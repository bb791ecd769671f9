# SPDX-License-Identifier: Apache-2.0
"""Files as such: atomic writes, locks, portable names, JSON."""
