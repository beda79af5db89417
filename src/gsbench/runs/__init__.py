"""The runs folder: layout, store, keys of steps, files of a trial, hashes, sources of user code. Loads no torch."""
