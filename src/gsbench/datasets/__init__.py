"""Public data sets: what there is, where it lies, and how its wanted parts come here. Loads no torch."""
