# SPDX-License-Identifier: Apache-2.0
"""From photographs or videos to a trained model, its report and pictures, in stages (`clsplat capture` and `demo`)."""
