"""From observations to joint offsets with their uncertainty."""
