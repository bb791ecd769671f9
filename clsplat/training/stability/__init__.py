# SPDX-License-Identifier: Apache-2.0
"""Non-finite values: detection, repair, and return to a checkpoint where they come again."""
