# SPDX-License-Identifier: Apache-2.0
"""gsplat's names, for programs that import gsplat: functions that clsplat replaces, and functions that it refuses."""
