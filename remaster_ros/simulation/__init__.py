"""The hidden world and the fake devices, which speak the real wire formats."""
