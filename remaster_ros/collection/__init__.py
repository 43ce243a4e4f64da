# SPDX-License-Identifier: Apache-2.0
"""What becomes of a measured configuration: pairing, plausibility, references."""
