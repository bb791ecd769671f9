# SPDX-License-Identifier: Apache-2.0
"""Many frames as a job: tasks, workers, what is there already, clusters."""
