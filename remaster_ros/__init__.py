"""Remaster a robot arm in place: joint zero-offsets with honest uncertainty."""

__version__ = '0.1.0'
