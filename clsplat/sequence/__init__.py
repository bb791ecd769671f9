# SPDX-License-Identifier: Apache-2.0
"""Rendering of many frames as a job: tasks, workers, finished frames, clusters."""
