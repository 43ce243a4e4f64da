# SPDX-License-Identifier: Apache-2.0
"""Hidden world of the simulation, and fake devices with the wire formats of real ones."""
