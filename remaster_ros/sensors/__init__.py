"""Measuring devices, one folder each: wire format, client, diagnosis."""
