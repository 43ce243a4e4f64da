# SPDX-License-Identifier: Apache-2.0
"""A Metropolis walk over models, measured beside the search of `discover`."""
