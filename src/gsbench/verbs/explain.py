"""``gsbench explain``: how a table's number came about."""

from collections.abc import Sequence
from pathlib import Path

from gsbench.analysis.explain import ADDRESS, explain_cell
from gsbench.verbs.arguments import ArgumentParser


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb; raises InputError for bad input."""
    parser = ArgumentParser(
        prog="gsbench explain", description="The runs, settings, data and code versions behind a cell of a table."
    )
    parser.add_argument("cell", metavar="CELL", help=f"a number of a table: {ADDRESS}")
    print(explain_cell(parser.parse_args(argv).cell, runs))
    return 0
