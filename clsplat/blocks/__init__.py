# SPDX-License-Identifier: Apache-2.0
"""Training of a large scene in blocks: the plan, which divides the ground into cells, and the blocks' loads."""
