# SPDX-License-Identifier: Apache-2.0
"""Verbs about blocks (`clsplat blocks plan`): each is a module, whose class of arguments is named after both words."""
