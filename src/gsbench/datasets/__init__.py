"""Public data sets: the catalogue, and fetching the wanted parts of their archives. Loads no
torch."""
