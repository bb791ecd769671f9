# SPDX-License-Identifier: Apache-2.0
"""Structure from motion with pycolmap, in a worker process."""
