# SPDX-License-Identifier: Apache-2.0
"""Render jobs for the frames of a shot: tasks, threads, existing files, frames shared between jobs, Dask clusters."""
