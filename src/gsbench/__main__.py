"""Command line without its script: ``python -m gsbench`` is ``gsbench``."""

from gsbench.cli import main

main()
