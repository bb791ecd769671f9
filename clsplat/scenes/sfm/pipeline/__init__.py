# SPDX-License-Identifier: Apache-2.0
"""Stages of a reconstruction, which the worker process runs: features, pairs, matching, mapping, and their database."""
