"""Verbs that show an experiment's results from its files: ``tables``, ``report``, ``explain``."""

import argparse
import json
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from gsbench.analysis.addresses import CELL, trials_of_arm
from gsbench.analysis.cells import (
    check_averageable,
    make_cell,
    select_trials,
    to_frame,
    where_words,
    with_variants,
)
from gsbench.analysis.comparison import Comparison, chosen, compare
from gsbench.analysis.fairness import fairness_table
from gsbench.analysis.paper import layout_of, load_published, paper_tables, published_table
from gsbench.analysis.quantities import Quantity, quantity
from gsbench.analysis.results import TrialResult, load_experiment
from gsbench.analysis.table_formats import FORMATS, csv_of
from gsbench.analysis.tables import build_table, format_cell
from gsbench.errors import InputError
from gsbench.files import own_output, writable_output, write_text
from gsbench.runs.code import edited
from gsbench.runs.experiments import list_experiments
from gsbench.verbs.arguments import options_of
from gsbench.words import some_of, split_outside_brackets

TRIALS, JSON = "trials", "json"
FAIRNESS = "fairness"
PAPER_NOTES = "paper"  # `gsbench tables paper` shows the paper's own inconsistencies
REPORT_NAME = "report.html"
FORMAT_NAMES = (*FORMATS, TRIALS, JSON)
LAYOUTS = (*load_published().tables, "plain", FAIRNESS)


def tables(argv: Sequence[str], runs: Path) -> int:
    """Run the verb; raises InputError for bad input."""
    options = options_of("tables", argv)
    options.format = options.format or _format_of(options.out)
    if options.experiment is None:
        print("\n".join(list_experiments(runs)) or f"no experiment in {runs} yet")
        return 0
    if options.experiment == PAPER_NOTES and not (runs / PAPER_NOTES).exists():
        print("\n".join(f"- {line}" for line in load_published().contradictions))
        return 0
    experiment, where = load_experiment(runs, options.experiment), dict(options.where)
    for warning in experiment.warnings:
        print(f"left out: {warning}", file=sys.stderr)
    trials = select_trials(experiment.trials, where)
    if options.format in (TRIALS, JSON):
        for name in ("rows", "columns", "metrics", "layout", "paper"):
            if getattr(options, name) is not None:
                raise InputError(f"--format {options.format} shows all, and takes no --{name}")
    if options.format == TRIALS:
        texts = {"-trials.csv": csv_of(to_frame(trials))}
    else:
        comparison = compare(experiment)
        if where:
            comparison = chosen(comparison, trials, where_words(where))
        if options.format == JSON:
            texts = {f".{JSON}": json.dumps(comparison.to_json(), indent=1) + "\n"}
        else:
            texts = _tables(comparison, trials, options)
    _write(texts, options.out, experiment.name)
    return 0


def _format_of(out: Path | None) -> str:
    """The format that the ending of the file ``out`` stands for, else Markdown."""
    if out is not None and not out.is_dir():
        for name, (suffix, _) in FORMATS.items():
            if out.suffix.lower() == f".{suffix}":
                return name
    return "md"


def _tables(
    comparison: Comparison, trials: Sequence[TrialResult], options: argparse.Namespace
) -> dict[str, str]:
    """The texts of the tables, by the ending of their file's name."""
    experiment, layout, metrics = comparison.experiment, options.layout, options.metrics
    if layout is None and options.rows is None and options.columns is None:
        layout = layout_of(experiment.name)
    if layout == FAIRNESS:
        return _fairness_sheets(comparison, options.format)
    if layout in (None, "plain"):
        rows, columns = options.rows, options.columns or ()
        if both := sorted(set(rows or ()) & set(columns)):
            raise InputError(f"{', '.join(both)} is in --rows and --columns: choose one")
        tables = [build_table(experiment, trials, rows, columns, metrics, comparison=comparison)]
    else:
        tables = paper_tables(experiment, layout, trials, metrics, comparison)
    suffix, writer = FORMATS[options.format]
    named = dict(zip(("", "-difference"), tables, strict=False))
    if options.paper is not None:
        named[f"-{options.paper}"] = published_table(with_variants(trials), options.paper)
    return {f"{end}.{suffix}": writer(table) for end, table in named.items()}


def _fairness_sheets(comparison: Comparison, format_name: str) -> dict[str, str]:
    """The fairness sheets of all compared pairs of arms."""
    experiment = comparison.experiment
    if not comparison.pairs:
        raise InputError(
            f"experiment {experiment.name} has one arm, so there is nothing to compare"
        )
    suffix, writer = FORMATS[format_name]
    sheets = {}
    for first, second in comparison.pairs:
        arms = (re.sub(r"[^\w.=-]+", "_", str(arm)) for arm in (second, first))
        end = f"-{FAIRNESS}-{'-'.join(arms)}.{suffix}"
        sheets[end] = writer(fairness_table(comparison.trials, first, second))
    return sheets


def _write(texts: Mapping[str, str], out: Path | None, name: str) -> None:
    """Print the texts, or write them to ``out``: a file if its ending is the format's, or a folder.

    In a folder, files are named after the experiment. Several texts get names beside the file
    ``out``.
    """
    if out is None:
        print("\n".join(texts.values()), end="")
        return
    for end, text in texts.items():
        suffix = Path(f"x{end}").suffix
        if out.suffix.lower() == suffix and not out.is_dir():
            part = "" if len(texts) == 1 else end.removesuffix(suffix)
            file = out.with_name(f"{out.stem}{part}{out.suffix}")
            output = writable_output if file == out else own_output
        else:
            file, output = out / f"{name}{end}", own_output
        with output(file):
            write_text(file, text)
        print(file)


def report(argv: Sequence[str], runs: Path) -> int:
    """Run the verb; raises InputError for bad input."""
    from gsbench.analysis.report.build import build_report  # here, for a quick answer to --help

    options = options_of("report", argv)
    experiment = load_experiment(runs, options.experiment)
    densifiers = sorted({trial.densify for trial in experiment.trials})
    if options.baseline is not None and options.baseline not in densifiers:
        raise InputError(
            f"--baseline {options.baseline}: {experiment.name} has {', '.join(densifiers)}"
        )
    for warning in experiment.warnings:
        print(f"left out: {warning}", file=sys.stderr)
    text = build_report(experiment, options.baseline, dict(options.where))
    out = options.out or experiment.folder / REPORT_NAME
    _write({f"-{REPORT_NAME}": text}, out, experiment.name)
    return 0


def explain(argv: Sequence[str], runs: Path) -> int:
    """Run the verb; raises InputError for bad input."""
    print(explain_cell(options_of("explain", argv).cell, runs))
    return 0


def explain_cell(address: str, runs: Path) -> str:
    """Plain text about the cell at ``address``; raises ``InputError`` if there is no such cell."""
    parts = split_outside_brackets(address, ":")
    if len(parts) != 4 or not all(parts):
        raise InputError(f"{address!r} is not {CELL}")
    name, scene, metric, arm = parts
    experiment = load_experiment(runs, name)
    of_scene = [trial for trial in with_variants(experiment.trials) if trial.scene == scene]
    if not of_scene:
        scenes = ", ".join(sorted({trial.scene for trial in experiment.trials}))
        raise InputError(f"experiment {name!r} has no scene {scene!r}; it has {scenes}")
    trials = trials_of_arm(of_scene, arm, f" of {scene}")
    shown = quantity(metric, trials)
    check_averageable(trials, f"scene={scene} {arm}")
    expected = len(experiment.seeds)
    cell = make_cell(trials, shown, [scene], expected)
    lines = [
        f"{shown.name} of {trials[0].arm} on {scene} in experiment {name}",
        f"  {format_cell(cell, shown)}: mean ± deviation (n - 1) over {cell.count} of {expected} "
        "trials",
    ]
    if cell.reason:
        lines.append(f"  not available: {cell.reason}")
    answers = compare(experiment).answers
    about = [one.line for one in answers if trials[0].arm in (one.arm, one.baseline)]
    about = about or ["none: it is compared with no other arm"]
    lines += ["", "Verdicts", *(f"  {line}" for line in about)]
    conditions = trials[0].conditions.items()
    lines += ["", "Conditions", *(f"  {key}: {value}" for key, value in conditions)]
    lines += _trials_lines(trials, shown)
    place = trials[0].path.parent
    is_older = any(trial.path.parent == place for trial in experiment.older)
    versions = experiment.versions if is_older else ()
    start = f"{place.relative_to(runs).as_posix()}/"
    if left_out := [*(line for line in experiment.faults if line.startswith(start)), *versions]:
        lines += ["", "Left out", *(f"  {line}" for line in left_out)]
    return "\n".join(lines)


def _trials_lines(trials: Sequence[TrialResult], shown: Quantity) -> list[str]:
    """The value and the origin of each trial; a line that repeats the last trial's is left out."""
    lines = ["", "Trials"]
    previous: dict[str, str] = {}
    for trial in trials:
        value, origin = shown.read(trial), _origin(trial)
        lines.append(f"  seed {trial.seed}: {'n/a' if value is None else f'{value:.6g}'}")
        new = origin.items() - previous.items()
        lines += [
            f"    {label:<9} {text}" for label, text in origin.items() if (label, text) in new
        ]
        previous = origin
    return lines


def _origin(trial: TrialResult) -> dict[str, str]:
    """The folder of a trial, its counts, hashes, and the programs that made it, by label."""
    record, code = trial.record, trial.record.code
    if not trial.from_renders:
        counts = f"{record.num_gaussians or 0:,} from {record.num_init_points or 0:,} points"
    else:
        counts = "its own renders" if trial.program else _listed(record.renders)
    views, by = record.test_views, record.trained_by
    differing = list(edited(code.packages))
    if len(differing) == len(code.packages):  # before the first release all count as edited
        differing = []
    origin = {
        "folder": str(trial.path),
        "Gaussians": counts,
        "views": f"{'?' if views is None else views} for testing",
        **{name: sha for name, sha in record.hashes.items() if name not in trial.conditions},
        "program": by and f"{by.version}: {' '.join(by.command)}",
        "machine": trial.machine,
        "code": ", ".join(trial.code_texts),
        "commit": code.commit and f"{code.commit}{', edited' if code.edited else ''}",
        "edited": differing and f"since the last release: {some_of(differing)}",
        "versions": _listed(record.versions),
    }
    return {label: str(text) for label, text in origin.items() if text}


def _listed(facts: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {value}" for name, value in facts.items())
