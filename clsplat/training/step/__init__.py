# SPDX-License-Identifier: Apache-2.0
"""Training step: inputs of its views, gradients and Adam, loss terms, components, and the monitor."""
