# SPDX-License-Identifier: Apache-2.0
"""`clsplat render`: verb, cameras, models and plan."""
