"""``gsbench report``: one HTML file with the evidence of an experiment."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gsbench.analysis.pairing import BASELINE
from gsbench.analysis.results import load_experiment
from gsbench.arguments import ArgumentParser
from gsbench.errors import InputError
from gsbench.files import write_text

REPORT_NAME = "report.html"


def main(argv: Sequence[str], runs: Path) -> int:
    """The verb; raises InputError for bad input."""
    from gsbench.analysis.report.build import build_report  # here, for a quick answer to --help

    parser = ArgumentParser(prog="gsbench report", description="One HTML file with the evidence of an experiment.")
    parser.add_argument("experiment")
    parser.add_argument("--out", type=Path, metavar="FILE", help=f"default: {REPORT_NAME} in the experiment's folder")
    parser.add_argument("--baseline", default=BASELINE, help=f"the densifier that others are held against ({BASELINE})")
    options = parser.parse_args(argv)
    experiment = load_experiment(runs, options.experiment)
    path = options.out or experiment.folder / REPORT_NAME
    text = build_report(experiment, options.baseline)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, text)
    except OSError as error:
        raise InputError(f"cannot write {path} ({error.strerror}); give another --out") from None
    print(path)
    return 0
