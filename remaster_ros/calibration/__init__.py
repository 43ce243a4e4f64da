# SPDX-License-Identifier: Apache-2.0
"""Joint offsets with their uncertainty, from observations."""
