# SPDX-License-Identifier: Apache-2.0
"""Model files, and edits of Gaussians on the host."""
