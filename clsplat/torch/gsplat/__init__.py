# SPDX-License-Identifier: Apache-2.0
"""gsplat's names for programs that import it: names that clsplat replaces, and names that it refuses."""
