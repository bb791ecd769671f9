# SPDX-License-Identifier: Apache-2.0
"""Videos as sources of photographs: decoding, colours, motion, and the choice of frames."""
