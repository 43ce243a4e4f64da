"""What becomes of a measured configuration: pairing, plausibility, references."""
