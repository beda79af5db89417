"""The runs folder: layout, store, keys of steps, files of a trial, hashes, versions of code.

This package loads no torch.
"""
