# SPDX-License-Identifier: Apache-2.0
"""Non-finite values in a training: detection, repair, and return to a checkpoint if they recur."""
