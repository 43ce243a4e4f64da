"""Physical effects beyond the zero-offsets: one file each, and one line each in `registry`."""
