"""Leica laser trackers by the emScon protocol."""
