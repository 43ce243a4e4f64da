# SPDX-License-Identifier: Apache-2.0
"""Leica laser trackers by the emScon protocol."""
