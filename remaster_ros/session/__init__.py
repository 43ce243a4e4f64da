"""Files: sessions, journals, bags, workcells."""
