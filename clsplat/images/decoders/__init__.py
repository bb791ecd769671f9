# SPDX-License-Identifier: Apache-2.0
"""Decoders of photographs that OpenImageIO's wheel does not read: HEIF, AVIF and raw files; and ICC profiles."""
