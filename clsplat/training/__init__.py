# SPDX-License-Identifier: Apache-2.0
"""The training step, the training loop, and recovery from non-finite values and failures."""
