# SPDX-License-Identifier: Apache-2.0
"""Non-finite values and repeated trouble: detection, repair, return to a checkpoint."""
