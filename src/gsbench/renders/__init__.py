"""Renders of other programs: measured as they are, or entered as trials."""
