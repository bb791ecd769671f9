# SPDX-License-Identifier: Apache-2.0
"""One training step: inputs of its views, gradients and Adam, loss terms, components, and the monitor."""
