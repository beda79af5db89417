"""Public data sets: the catalogue, and fetching parts of their archives. Loads no torch."""
