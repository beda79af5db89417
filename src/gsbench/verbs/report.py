"""``gsbench report``: one HTML file with the evidence of an experiment."""

from __future__ import annotations


def main(argv: list[str]) -> int:
    from gsbench.analysis.report.build import main_report
    from gsbench.cli import runs_dir

    return main_report(argv, runs_dir())
