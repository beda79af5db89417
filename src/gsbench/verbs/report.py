"""``gsbench report``: one HTML file with the evidence of an experiment."""

from __future__ import annotations


def main(argv: list[str]) -> int:
    from gsbench.cli import runs_dir
    from gsbench.eval.report.build import main_report

    return main_report(argv, runs_dir())
