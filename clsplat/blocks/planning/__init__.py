# SPDX-License-Identifier: Apache-2.0
"""Making of a plan: ground axes, division into cells, their loads by the coarse model, and a picture."""
