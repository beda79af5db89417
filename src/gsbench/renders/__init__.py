"""Measuring renders of other programs, and importing them as trials."""
