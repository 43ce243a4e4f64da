# SPDX-License-Identifier: Apache-2.0
"""From observations to joint offsets with their uncertainty."""
