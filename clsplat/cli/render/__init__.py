# SPDX-License-Identifier: Apache-2.0
"""`clsplat render`: flags, their request, its job, the plan, and the writing of frames."""
