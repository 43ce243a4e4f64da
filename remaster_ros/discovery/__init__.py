"""Errors that the joint offsets leave unexplained, and their physical causes."""
