# SPDX-License-Identifier: Apache-2.0
"""Evaluation of models: PSNR, SSIM and LPIPS of renders against held-out photographs."""
