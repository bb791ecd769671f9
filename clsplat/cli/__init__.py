# SPDX-License-Identifier: Apache-2.0
"""The command line `clsplat`: a module for each verb, parsing of flags, and help."""
