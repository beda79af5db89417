"""The steps of a trial: what each depends on, and how it is built.

`gsbench.pipeline.trial` puts them together.
"""
