"""``gsbench tables``: tables of an experiment from its result files."""

from __future__ import annotations


def main(argv: list[str]) -> int:
    from gsbench.analysis.tables_cli import main_tables
    from gsbench.cli import runs_dir

    return main_tables(argv, runs_dir())
