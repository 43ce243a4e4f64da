# SPDX-License-Identifier: Apache-2.0
"""The whole pipeline on fake hardware, as `remaster demo` runs it."""
