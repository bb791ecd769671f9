# SPDX-License-Identifier: Apache-2.0
"""The demo (`clsplat demo`): synthetic photographs of a still life, training on them, and a synthetic town."""
