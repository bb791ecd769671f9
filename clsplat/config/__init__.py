# SPDX-License-Identifier: Apache-2.0
"""Settings, with each default defined once, and the table of channels."""
