"""The hidden world, and fake devices with the real wire formats."""
