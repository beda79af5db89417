"""Extraction and matching of local features by networks."""
