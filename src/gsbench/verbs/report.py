"""``gsbench report``: one HTML file with the evidence of an experiment."""

import sys
from collections.abc import Sequence
from pathlib import Path

from gsbench.analysis.pairing import BASELINE
from gsbench.analysis.results import load_experiment
from gsbench.errors import InputError
from gsbench.files import writable_output, write_text
from gsbench.verbs.arguments import ArgumentParser, path

REPORT_NAME = "report.html"
FILE_SUFFIXES = (".html", ".htm")


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb; raises InputError for bad input."""
    from gsbench.analysis.report.build import build_report  # here, for a quick answer to --help

    parser = ArgumentParser(prog="gsbench report", description="One HTML file with the evidence of an experiment.")
    parser.add_argument("experiment")
    parser.add_argument(
        "--out", type=path, metavar="PATH", help=f"a folder or a .html file; default: {REPORT_NAME} with the experiment"
    )
    parser.add_argument("--baseline", help=f"the densifier to compare with ({BASELINE})")
    options = parser.parse_args(argv)
    experiment = load_experiment(runs, options.experiment)
    densifiers = sorted({trial.densify for trial in experiment.trials})
    if options.baseline is not None and options.baseline not in densifiers:
        raise InputError(f"--baseline {options.baseline}: {experiment.name} has {', '.join(densifiers)}")
    file = experiment.folder / REPORT_NAME if options.out is None else file_at(options.out, experiment.name)
    for warning in experiment.warnings:
        print(f"left out: {warning}", file=sys.stderr)
    text = build_report(experiment, options.baseline or BASELINE)
    with writable_output(file):
        write_text(file, text)
    print(file)
    return 0


def file_at(out: Path, experiment: str) -> Path:
    """The file that ``--out`` means: ``out`` itself, or in a folder a file named after the experiment."""
    is_file = out.suffix.lower() in FILE_SUFFIXES and not out.is_dir()
    return out if is_file else out / f"{experiment}-{REPORT_NAME}"
