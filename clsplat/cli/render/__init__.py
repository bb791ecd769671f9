# SPDX-License-Identifier: Apache-2.0
"""`clsplat render`: its flags and their checks, the cameras, the plan of --dry-run, and the writing of frames."""
