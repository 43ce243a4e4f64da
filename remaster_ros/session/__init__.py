# SPDX-License-Identifier: Apache-2.0
"""Files: sessions, journals, bags, workcells."""
