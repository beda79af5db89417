"""``gsbench judge``: the verdict on results of any trainer, from a table or a folder of renders."""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from gsbench.analysis.frames import (
    COLUMNS,
    DIRECTIONS,
    Declared,
    compare_methods,
)
from gsbench.errors import InputError
from gsbench.files import require_regular, writable_output, write_text
from gsbench.parsing import Count, one_line, read_typed
from gsbench.runs.experiments import DEFAULT_METRIC
from gsbench.verbs.arguments import ArgumentParser, Rows, comma_separated, names, number, path
from gsbench.words import counted, listed, printable

if TYPE_CHECKING:
    import pandas as pd

ROWS: Rows = {
    "results? RESULTS": ("a table or a folder", path),
    "settings* KEY=VALUE": "eval.… for a folder of renders",
    "--baseline NAME": "the method to compare with",
    "--metric NAME": f"a column that decides ({DEFAULT_METRIC})",
    "--better WHAT": (
        "which values are better, for a metric that gsbench does not know",
        [name for name in DIRECTIONS if name],
    ),
    "--least SIZE": "the least difference that matters, as 0.1 or 10%%; default: the metric's",
    "--truth DIR": ("of a folder of renders: photographs by scene", path),
    "--out FILE.html": ("write the report, too", path),
    "--json": "print a JSON object instead of the table",
    "--declared FILE": ("the question that --declare wrote", path),
    "--declare FILE": ("before the training: write the question, and judge nothing", path),
    "--methods A,B": ("with --declare: all but the baseline", names),
    "--scenes A,B": ("with --declare", names),
    "--seeds 0,1": (
        "with --declare",
        comma_separated(number(Count)),
    ),
}


def judge(argv: Sequence[str], runs: Path) -> int:
    """Run the verb; raises InputError for bad input."""
    options = ArgumentParser(
        "judge",
        "RESULTS is a table with the columns method, scene, seed and metrics, or a folder of "
        "renders {arm}/{scene}/{seed} (docs/other_trainers.md). A missing value, or a row that "
        "only one of two methods has, is a training that failed. The verdict has 5 %; it holds if "
        "metric, scenes and seeds were chosen before.",
        ROWS,
    ).parse_args(argv)
    if options.declare is not None:
        return _declare(options)
    if options.results is None:
        raise InputError("judge needs RESULTS: a table (.csv) or a folder {arm}/{scene}/{seed}")
    if options.declared is not None:
        if not options.declared.is_file():
            raise InputError(f"{options.declared}: no such file: judge --declare writes it")
        asked = read_typed(options.declared, Declared)
        _require_as_declared(options, asked)
    elif options.baseline is None:
        raise InputError("judge needs --baseline NAME, one of the methods")
    else:
        asked = _asked(options)
    comparison = compare_methods(_frame(options), asked, options.results.stem)
    if options.json:
        print(json.dumps(comparison.to_json(), indent=1))
    else:
        from gsbench.analysis.table_formats import to_markdown
        from gsbench.analysis.tables import build_table

        table = build_table(comparison.experiment, rows=("scene", "densify"), comparison=comparison)
        print(to_markdown(replace(table, row_headings=("scene", "method"))), end="")
    if options.out is not None:
        from gsbench.analysis.report.build import build_report

        with writable_output(options.out):
            write_text(options.out, build_report(comparison.experiment))
        print(options.out, file=sys.stderr)
    return 0


def _declare(options: argparse.Namespace) -> int:
    """Write the question of trainings to come."""
    needed = ("baseline", "methods", "scenes", "seeds")
    if lacking := [f"--{name}" for name in needed if not getattr(options, name)]:
        raise InputError(f"judge --declare needs {listed(lacking)}, too")
    if options.results is not None or options.declared is not None:
        raise InputError("judge --declare comes before the results: leave them out")
    asked = replace(
        _asked(options),
        methods=options.methods,
        scenes=options.scenes,
        seeds=tuple(options.seeds),
    )
    if options.declare.exists():
        raise InputError(f"{options.declare} is there already: a question is not changed")
    write_text(options.declare, json.dumps(asked.to_json(), indent=1) + "\n")
    trials = (1 + len(asked.methods)) * len(asked.scenes) * len(asked.seeds)
    print(f"{options.declare}: {counted(len(asked.methods), 'question')}, {trials} trainings")
    return 0


def _asked(options: argparse.Namespace) -> Declared:
    return Declared(
        baseline=options.baseline,
        metric=options.metric or DEFAULT_METRIC,
        better=options.better or "",
        least=options.least,
    )


def _require_as_declared(options: argparse.Namespace, declared: Declared) -> None:
    """Raise InputError for an option that says something else than what was declared."""
    for name in ("baseline", "metric", "least", "better"):
        value, known = getattr(options, name), getattr(declared, name)
        if value not in (None, known):
            raise InputError(f"--{name} {value}: {known} was declared: leave the option out")


def _frame(options: argparse.Namespace) -> "pd.DataFrame":
    """The table of results; that of a folder is measured now."""
    import pandas as pd  # here, since it is slow to import

    place = options.results
    if place.is_dir():
        from gsbench.renders.measure import measure_folders

        if options.truth is None:
            raise InputError("a folder of renders needs --truth DIR: photographs by scene")
        return pd.DataFrame(measure_folders(place, options.truth, options.settings))
    if options.settings or options.truth is not None:
        raise InputError("KEY=VALUE and --truth are for a folder of renders, not for a table")
    try:
        require_regular(place)
        frame = pd.read_csv(place, dtype=dict.fromkeys(COLUMNS[:2], str), keep_default_na=True)
    except FileNotFoundError:
        raise InputError(f"{place}: no such file") from None
    except (ValueError, UnicodeDecodeError, pd.errors.ParserError) as error:
        raise InputError(
            f"{place} is no table of comma-separated values ({one_line(str(error))}); "
            "`gsbench site` shows archives"
        ) from None
    for name in COLUMNS[:2]:
        if name in frame:
            frame[name] = [printable(" ".join(str(value).split())) for value in frame[name]]
    return frame
