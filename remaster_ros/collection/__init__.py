# SPDX-License-Identifier: Apache-2.0
"""Processing of a measured configuration: pairing, plausibility, references."""
