"""Renders of other programs: measured as they are, or imported as trials."""
