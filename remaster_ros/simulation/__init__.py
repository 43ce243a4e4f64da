# SPDX-License-Identifier: Apache-2.0
"""The hidden world, and fake devices with the real wire formats."""
