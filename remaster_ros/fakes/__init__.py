"""Fake devices that speak the real wire formats, behind one hidden World."""
