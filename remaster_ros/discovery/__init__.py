"""What the joint offsets leave unexplained, and its physical cause."""
