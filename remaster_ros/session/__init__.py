# SPDX-License-Identifier: Apache-2.0
"""Files: sessions, bags and workcells, a folder each; here what they share and what joins them."""
