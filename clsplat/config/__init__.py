# SPDX-License-Identifier: Apache-2.0
"""Settings, each default once, and nothing else."""
