# SPDX-License-Identifier: Apache-2.0
"""Tasks on processes of this machine, or on a Dask cluster: claims, repeated attempts, logs. A task is a command."""
