"""The ``remaster`` command: one file per verb."""
