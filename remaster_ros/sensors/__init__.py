# SPDX-License-Identifier: Apache-2.0
"""Measuring devices, one folder each: wire format, client, diagnosis."""
