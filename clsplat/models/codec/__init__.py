# SPDX-License-Identifier: Apache-2.0
"""Values, axes and byte layouts that several model formats share."""
