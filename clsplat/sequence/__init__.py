# SPDX-License-Identifier: Apache-2.0
"""Rendering of a shot's frames as a job: tasks, threads, existing files, frames shared between jobs, Dask clusters."""
