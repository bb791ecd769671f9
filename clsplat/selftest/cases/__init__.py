# SPDX-License-Identifier: Apache-2.0
"""Cases, which compare stages with their float64 twins, and the stages of the self-test."""
