# SPDX-License-Identifier: Apache-2.0
"""Which configurations are measured, and in which order."""
