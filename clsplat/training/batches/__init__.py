# SPDX-License-Identifier: Apache-2.0
"""Steps of several views, on one device or several: chunks in view, sums of gradients, and further devices."""
